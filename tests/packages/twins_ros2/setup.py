from setuptools import find_packages, setup

setup(
    name="twins_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/twins_ros2"]),
        ("share/twins_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Does what greeter_cpp, adder_py and crossing_py do in ROS 1, for stories that are told of both.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "greeter = twins_ros2.greeter:main",
            "adder = twins_ros2.adder:main",
            "caller = twins_ros2.caller:main",
        ]
    },
)
