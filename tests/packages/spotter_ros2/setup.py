from setuptools import find_packages, setup

setup(
    name="spotter_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/spotter_ros2"]),
        ("share/spotter_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Finds things in what its cameras see: nodes in namespaces that their programs give them.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "spotter = spotter_ros2.node:one",
            "lookout = spotter_ros2.node:high",
            "spotters = spotter_ros2.node:two",
        ]
    },
)
