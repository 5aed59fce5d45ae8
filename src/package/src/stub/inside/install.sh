#!/bin/sh
# Installs the stub of @PACKAGE@ on this robot, as an overlay in front of its other ROS packages, or takes it away.
#
#   sh install.sh [--prefix DIR] [--server URL] [--ca FILE] [--token TOKEN] [--robot NAME] [--force]
#   sh install.sh --uninstall [--prefix DIR]
#
# --ca: for a server of wss://, the certificate of the authority to trust, where the system does not.
# Without --prefix: /opt/cloudroid for root, ~/.cloudroid for anybody else. Several stubs share one overlay.
set -eu

package='@PACKAGE@'
case $0 in */*) here=${0%/*} ;; *) here=. ;; esac
here=$(cd "$here" && pwd)

complain() {
  echo "install.sh: $*" >&2
  exit 1
}

usage() {
  sed -n '2,/^set -eu/{/^#/s/^# \{0,1\}//p;}' "$here/install.sh"
}

uninstall=false force=false prefix='' server='' ca='' token='' robot=''
# Installed, it stands in the overlay's share/PKG; in the archive, at its top.
if [ ! -e "$here/.catkin" ]; then
  prefix=$(cd "$here/../.." && pwd)
fi
while [ $# -gt 0 ]; do
  case $1 in
    --uninstall) uninstall=true ;;
    --force) force=true ;;
    --prefix | --server | --ca | --token | --robot)
      [ $# -gt 1 ] || complain "$1 needs a value"
      case $1 in
        --prefix) prefix=$2 ;;
        --server) server=$2 ;;
        --ca) ca=$2 ;;
        --token) token=$2 ;;
        --robot) robot=$2 ;;
      esac
      shift
      ;;
    -h | --help) usage; exit 0 ;;
    *) usage >&2; complain "there is no option $1" ;;
  esac
  shift
done
if [ -z "$prefix" ]; then
  if [ "$(id -u)" = 0 ]; then prefix=/opt/cloudroid; else prefix=$HOME/.cloudroid; fi
fi
case $prefix in /*) ;; *) prefix=$(pwd)/$prefix ;; esac
case $prefix in *[:\'\"\\]*) complain "$prefix: a directory on a search path cannot have colons or quotes in its name" ;; esac
share=$prefix/share/$package
lib=$prefix/lib/$package

# rospack remembers for a minute where packages are.
refresh() {
  if command -v rospack > /dev/null; then rospack profile > /dev/null 2>&1 || true; fi
}

if $uninstall; then
  [ -e "$share/revision.toml" ] || complain "no stub of $package is installed in $prefix"
  rm -rf "$lib" "$share"
  # The overlay itself goes with its last stub.
  if rmdir "$prefix/lib" 2> /dev/null; then
    rmdir "$prefix/share" 2> /dev/null || true
    rm -f "$prefix/.catkin" "$prefix/setup.sh" "$prefix/setup.bash" "$prefix/setup.zsh"
    rmdir "$prefix" 2> /dev/null || true
  fi
  refresh
  echo "The stub of $package is gone from $prefix; shells that sourced it find the original again."
  exit 0
fi

[ -e "$here/.catkin" ] || complain "this copy can only --uninstall; install from the unpacked archive"
if [ -e "$share" ] && [ ! -e "$share/revision.toml" ]; then
  complain "$share is there and is no stub: choose another --prefix"
fi
stub=$here/lib/$package/cloudroid-stub
if ! "$stub" --version > /dev/null 2>&1; then
  complain "$stub does not run on this machine ($(uname -m)): get the stub for its architecture, ?arch= or cloudroidctl stub --arch"
fi

# What the robot's owner has set in an earlier stub.toml is kept.
settings=$(mktemp)
secret=$(mktemp)
trap 'rm -f "$settings" "$secret"' EXIT
if [ -e "$share/stub.toml" ]; then cat "$share/stub.toml" > "$settings"; else cat "$here/share/$package/stub.toml" > "$settings"; fi
# KEY VALUE: in place of the line that sets it or shows how to, else before all tables.
set_key() {
  key=$1 value=$2 awk '
    BEGIN {
      key = ENVIRON["key"]; value = ENVIRON["value"]
      gsub(/[\\"]/, "\\\\&", value)
      line = key " = \"" value "\""
    }
    $0 ~ "^(# *)?" key " *=" && !done { print line; done = 1; next }
    $0 ~ "^" key " *=" { next }
    /^\[/ && !done { print line; done = 1 }
    { print }
    END { if (!done) print line }
  ' "$settings" > "$settings.new"
  cat "$settings.new" > "$settings"
  rm -f "$settings.new"
}
if [ -n "$robot" ]; then set_key robot "$robot"; fi
if [ -n "$server" ]; then set_key server "$server"; fi
if [ -n "$ca" ]; then
  [ -r "$ca" ] || complain "cannot read $ca; --ca names a PEM file"
  set_key ca_file "$share/ca.pem"
elif [ -e "$share/ca.pem" ]; then
  ca=$share/ca.pem
fi
if [ -n "$token" ]; then
  printf '%s\n' "$token" > "$secret"
  set_key token_file "$share/token"
elif [ -e "$share/token" ]; then
  cat "$share/token" > "$secret"
fi

# Address, token and clock, before anything is changed.
trial=$(mktemp -d)
trap 'rm -rf "$settings" "$secret" "$trial"' EXIT
cp "$here/share/$package/"*.toml "$trial/"
cat "$settings" > "$trial/stub.toml"
if [ -s "$secret" ]; then
  CLOUDROID_TOKEN_FILE=$secret
  export CLOUDROID_TOKEN_FILE
fi
if [ -n "$ca" ]; then
  cat "$ca" > "$trial/ca.pem"
  ca=$trial/ca.pem
  CLOUDROID_CA_FILE=$ca
  export CLOUDROID_CA_FILE
fi
if ! "$stub" doctor --share "$trial" --package "$package" --only server; then
  $force || complain "nothing was installed: fix this, or install all the same with --force"
fi

mkdir -p "$prefix/lib" "$prefix/share"
rm -rf "$lib" "$share.old"
if [ -e "$share" ]; then mv "$share" "$share.old"; fi
cp -R "$here/lib/$package" "$lib"
cp -R "$here/share/$package" "$share"
cp "$here/install.sh" "$share/install.sh"
cat "$settings" > "$share/stub.toml"
if [ -s "$secret" ]; then
  # A file of this name that came with the package would keep its rights.
  rm -rf "$share/token"
  (umask 077 && cat "$secret" > "$share/token")
fi
if [ -n "$ca" ]; then cat "$ca" > "$share/ca.pem"; fi
rm -rf "$share.old"
for file in setup.bash setup.zsh .catkin; do cp "$here/$file" "$prefix/$file"; done
sed "s|^_cloudroid_installed=.*|_cloudroid_installed='$prefix'|" "$here/setup.sh" > "$prefix/setup.sh.new"
mv "$prefix/setup.sh.new" "$prefix/setup.sh"
refresh

case ${SHELL:-} in */zsh) setup=setup.zsh ;; */bash) setup=setup.bash ;; *) setup=setup.sh ;; esac
cat << END
Installed in $prefix. Source it after every other setup file, in each shell or at the end of its rc file:

    . $prefix/$setup

To look whether all is well:  rosrun $package cloudroid-stub doctor
To undo this:                 sh $share/install.sh --uninstall
END
