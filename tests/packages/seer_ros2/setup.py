from setuptools import find_packages, setup

setup(
    name="seer_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/seer_ros2"]),
        ("share/seer_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Finds what is bright in pictures.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["people_detect = seer_ros2.node:main"]},
)
