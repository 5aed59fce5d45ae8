# Puts this overlay in front of the robot's other ROS packages:  source setup.zsh
_cloudroid_here=${${(%):-%x}:a:h}
. "$_cloudroid_here/setup.sh"
