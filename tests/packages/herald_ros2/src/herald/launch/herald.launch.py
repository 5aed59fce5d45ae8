from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("salutation", default_value="Hello"),
            Node(
                package="herald",
                executable="herald",
                name="crier",
                namespace="square",
                parameters=[{"salutation": LaunchConfiguration("salutation"), "volumes": [1, 2]}],
                remappings=[("name", "guest")],
                respawn=True,
                respawn_delay=0.5,
            ),
        ]
    )
