from setuptools import find_packages, setup

setup(
    name="sharer_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/sharer_ros2"]),
        ("share/sharer_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Answers services and an action, and keeps nothing of what it was asked.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["sharer = sharer_ros2.node:main"]},
)
