from setuptools import find_packages, setup

setup(
    name="duet_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/duet_ros2"]),
        ("share/duet_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Sings in two voices: a program of two nodes.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["duet = duet_ros2.node:main"]},
)
