from setuptools import find_packages, setup

setup(
    name="localiser_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/localiser_ros2"]),
        ("share/localiser_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Finds where a robot is: the one cell of the map whose walls are as far as the scan says.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["localiser = localiser_ros2.node:main"]},
)
