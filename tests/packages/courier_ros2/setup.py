from setuptools import find_packages, setup

setup(
    name="courier_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/courier_ros2"]),
        ("share/courier_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Carries letters by a route that the robot names, and opens parcels where the robot permits it.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["courier = courier_ros2.node:main"]},
)
