# Puts this overlay in front of the robot's other ROS 2 packages:  . setup.sh
#
# It is sourced: it keeps to what sh, bash and zsh have in common, reads no positional parameter (after a bare "."
# those are the caller's), and leaves nothing behind but the variable it is for. Tools of ROS 2 go by AMENT_PREFIX_PATH alone: here are
# programs and shared files, no libraries, Python modules or files of CMake, which stay those of the original.

# sh cannot know where a sourced file is. setup.bash and setup.zsh say so; for sh, install.sh has written it here, and
# set-up files of workspaces that were built over this one say it by a variable of colcon.
_cloudroid_installed=''
_cloudroid_prefix=${_cloudroid_here:-${_cloudroid_installed:-${COLCON_CURRENT_PREFIX:-}}}

if [ -d "$_cloudroid_prefix/share/ament_index" ]; then
  if [ -z "${AMENT_PREFIX_PATH:-}" ]; then
    echo "setup.sh: ROS 2's own set-up file was not sourced before this one (. /opt/ros/DISTRIBUTION/setup.sh): sourced later, it is searched first" >&2
  fi
  # The overlay first, once.
  _cloudroid_left=${AMENT_PREFIX_PATH:-}:
  _cloudroid_kept=$_cloudroid_prefix
  while [ -n "$_cloudroid_left" ]; do
    _cloudroid_item=${_cloudroid_left%%:*}
    _cloudroid_left=${_cloudroid_left#*:}
    case $_cloudroid_item in
      '' | "$_cloudroid_prefix") ;;
      *) _cloudroid_kept=$_cloudroid_kept:$_cloudroid_item ;;
    esac
  done
  export "AMENT_PREFIX_PATH=$_cloudroid_kept"
else
  echo "setup.sh does not know its directory: run install.sh, or source setup.bash or setup.zsh instead" >&2
fi
unset _cloudroid_here _cloudroid_installed _cloudroid_prefix _cloudroid_left _cloudroid_kept _cloudroid_item
