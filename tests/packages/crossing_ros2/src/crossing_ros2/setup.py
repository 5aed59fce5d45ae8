from setuptools import find_packages, setup

setup(
    name="crossing_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/crossing_ros2"]),
        ("share/crossing_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Uses what has to cross between a robot and its servant: stamps, transforms, simulated time, actions.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["crossing = crossing_ros2.node:main"]},
)
