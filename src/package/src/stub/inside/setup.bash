# Puts this overlay in front of the robot's other ROS packages:  source setup.bash
_cloudroid_here=$(builtin cd "$(dirname "${BASH_SOURCE[0]}")" > /dev/null && pwd)
. "$_cloudroid_here/setup.sh"
