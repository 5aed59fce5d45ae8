from setuptools import find_packages, setup

setup(
    name="sights_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/sights_ros2"]),
        ("share/sights_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Publishes what people look at.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["sights = sights_ros2.node:main"]},
)
