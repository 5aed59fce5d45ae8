import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    share = get_package_share_directory("board_pose")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=os.path.join(share, "config", "board_pose.yaml"),
                description="Parameters of the node: which board is looked for.",
            ),
            DeclareLaunchArgument("image", default_value="image", description="Topic of the pictures."),
            DeclareLaunchArgument("camera_info", default_value="camera_info", description="Topic of the camera's calibration."),
            Node(
                package="board_pose",
                executable="board_pose",
                name="board_pose",
                output="screen",
                parameters=[LaunchConfiguration("params_file")],
                remappings=[
                    ("image", LaunchConfiguration("image")),
                    ("camera_info", LaunchConfiguration("camera_info")),
                ],
            ),
        ]
    )
