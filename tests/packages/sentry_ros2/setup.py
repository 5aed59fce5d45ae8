from setuptools import find_packages, setup

setup(
    name="sentry_ros2",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/sentry_ros2"]),
        ("share/sentry_ros2", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Raises alarms while it is on duty; two more nodes pass large pictures to each other.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "sentry = sentry_ros2.sentry:main",
            "eye = sentry_ros2.pictures:eye",
            "reader = sentry_ros2.pictures:reader",
        ]
    },
)
