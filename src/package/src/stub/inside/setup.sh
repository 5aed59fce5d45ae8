# Puts this overlay in front of the robot's other ROS packages:  . setup.sh
#
# It is sourced: it keeps to what sh, bash and zsh have in common, reads no positional parameter (after a bare "."
# those are the caller's), and leaves nothing behind but the two variables it is for. Both are needed: catkin's tools
# go by CMAKE_PREFIX_PATH, rospack and rospkg by ROS_PACKAGE_PATH.

# sh cannot know where a sourced file is. setup.bash and setup.zsh say so; for sh, install.sh has written it here.
_cloudroid_installed=''
_cloudroid_prefix=${_cloudroid_here:-$_cloudroid_installed}

# NAME DIRECTORY DEFAULT: puts the directory first in the variable's list, once.
_cloudroid_first() {
  eval "_cloudroid_left=\${$1:-\$3}:"
  _cloudroid_kept=$2
  while [ -n "$_cloudroid_left" ]; do
    _cloudroid_item=${_cloudroid_left%%:*}
    _cloudroid_left=${_cloudroid_left#*:}
    case $_cloudroid_item in
      '' | "$2") ;;
      *) _cloudroid_kept=$_cloudroid_kept:$_cloudroid_item ;;
    esac
  done
  export "$1=$_cloudroid_kept"
}

if [ -e "$_cloudroid_prefix/.catkin" ]; then
  # Where a robot's ROS is the distribution's own, both are unset and mean these.
  _cloudroid_first CMAKE_PREFIX_PATH "$_cloudroid_prefix" /usr
  _cloudroid_first ROS_PACKAGE_PATH "$_cloudroid_prefix/share" /usr/share
else
  echo "setup.sh does not know its directory: run install.sh, or source setup.bash or setup.zsh instead" >&2
fi
unset -f _cloudroid_first
unset _cloudroid_here _cloudroid_installed _cloudroid_prefix _cloudroid_left _cloudroid_kept _cloudroid_item
