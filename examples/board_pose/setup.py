from setuptools import find_packages, setup

setup(
    name="board_pose",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/board_pose"]),
        ("share/board_pose", ["package.xml"]),
        ("share/board_pose/launch", ["launch/board_pose.launch.py"]),
        ("share/board_pose/config", ["config/board_pose.yaml"]),
    ],
    install_requires=["setuptools"],
    maintainer="The Cloudroid authors",
    maintainer_email="cloudroid@example.org",
    description="Finds a chessboard in pictures of a calibrated camera, and says where it is.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["board_pose = board_pose.node:main"]},
)
