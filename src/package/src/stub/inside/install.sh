#!/bin/sh
# Installs the stub of @PACKAGE@ on this robot, as an overlay in front of its other ROS packages, or removes it.
#
#   sh install.sh [--prefix DIR] [--pair LINE] [--key KEY] [--server URL] [--ca FILE] [--fingerprint SHA256:HEX] [--token TOKEN]
#                 [--robot NAME] [--force]
#   sh install.sh --uninstall [--prefix DIR]
#
# --pair: the line that cloudroidctl pair ROBOT prints on the server, in single quotes. This robot then creates its own key and gets
# a certificate. The line also contains the server's address and key, and the robot's name.
# --key: the server's key ("ssh-ed25519 AAAA...", or a file that contains it), which must have signed this archive and later ones.
# Default: the key that signed this package's previous stub, else a key that is known in the overlay, else the key in the archive.
# --ca: for a wss:// server, PEM file of the authority to trust, if the system does not trust it.
# --fingerprint: for a wss:// server, the fingerprint of its certificate, if no authority has signed it.
# --prefix: default /opt/cloudroid for root, ~/.cloudroid for other users. Several stubs share one overlay.
set -eu

package='@PACKAGE@'
ros=@ROS@
case $0 in */*) here=${0%/*} ;; *) here=. ;; esac
here=$(cd "$here" && pwd)

complain() {
  echo "install.sh: $*" >&2
  exit 1
}

usage() {
  sed -n '2,/^set -eu/{/^#/s/^# \{0,1\}//p;}' "$here/install.sh"
}

uninstall=false force=false prefix='' line='' key='' server='' ca='' fingerprint='' token='' robot=''
# Installed, it stands in the overlay's share/PKG; in the archive, at its top.
if [ ! -d "$here/share/$package" ]; then
  prefix=$(cd "$here/../.." && pwd)
fi
while [ $# -gt 0 ]; do
  case $1 in
    --uninstall) uninstall=true ;;
    --force) force=true ;;
    --prefix | --pair | --key | --server | --ca | --fingerprint | --token | --robot)
      [ $# -gt 1 ] || complain "$1 needs a value"
      case $1 in
        --prefix) prefix=$2 ;;
        --pair) line=$2 ;;
        --key) key=$2 ;;
        --server) server=$2 ;;
        --ca) ca=$2 ;;
        --fingerprint) fingerprint=$2 ;;
        --token) token=$2 ;;
        --robot) robot=$2 ;;
      esac
      shift
      ;;
    -h | --help) usage; exit 0 ;;
    *) usage >&2; complain "unknown option $1" ;;
  esac
  shift
done
if [ -z "$prefix" ]; then
  if [ "$(id -u)" = 0 ]; then prefix=/opt/cloudroid; else prefix=$HOME/.cloudroid; fi
fi
case $prefix in /*) ;; *) prefix=$(pwd)/$prefix ;; esac
case $prefix in *[:\'\"\\]*) complain "$prefix: the prefix must not contain colons, quotes or backslashes" ;; esac
share=$prefix/share/$package
lib=$prefix/lib/$package

index=$prefix/share/ament_index
# What stands at the top of the overlay, beside its packages.
case $ros in
  1) setups='setup.sh' copied='setup.bash setup.zsh .catkin' ;;
  2) setups='setup.sh local_setup.sh' copied='setup.bash setup.zsh local_setup.bash local_setup.zsh' ;;
esac

# What ament's index says of this package, and what leads to its original.
unregister() {
  rm -f "$index/resource_index"/*/"$package" "$prefix/lib/lib${package}__rosidl_"*
}

# Generic subscriptions of rclcpp (rosbag2, bridges) look for the code of message types below the install space of their package, which
# this overlay is now: links lead to the original's.
link_types() {
  [ -e "$index/resource_index/rosidl_interfaces/$package" ] || return 0
  left=${AMENT_PREFIX_PATH:-}:
  while [ -n "$left" ]; do
    item=${left%%:*} left=${left#*:}
    if [ -z "$item" ] || [ "$item" = "$prefix" ]; then continue; fi
    for library in "$item/lib/lib${package}__rosidl_"*.so; do
      if [ -e "$library" ]; then ln -sf "$library" "$prefix/lib/"; left=''; fi
    done
  done
}

# rospack remembers for a minute where packages are.
refresh() {
  if [ $ros = 1 ] && command -v rospack > /dev/null; then rospack profile > /dev/null 2>&1 || true; fi
}

if $uninstall; then
  [ -e "$share/revision.toml" ] || complain "no stub of $package is installed in $prefix"
  rm -rf "$lib" "$share"
  unregister
  # The overlay itself goes with its last stub.
  if rmdir "$prefix/lib" 2> /dev/null; then
    rm -rf "$index"
    rmdir "$prefix/share" 2> /dev/null || true
    for file in $setups $copied servers.pub; do rm -f "$prefix/$file"; done
    rmdir "$prefix" 2> /dev/null || true
  fi
  refresh
  echo "Removed the stub of $package from $prefix; shells that sourced it find the original again."
  exit 0
fi

[ -d "$here/share/$package" ] || complain "this copy can only --uninstall; install from the unpacked archive"
if [ -e "$share" ] && [ ! -e "$share/revision.toml" ]; then
  complain "$share exists and is not a stub: choose another --prefix"
fi
# One set-up file puts one ROS's stubs in front.
case $ros in 1) others=2 mark=$index ;; 2) others=1 mark=$prefix/.catkin ;; esac
[ ! -e "$mark" ] || complain "$prefix contains stubs of ROS $others, but this one is of ROS $ros: choose another --prefix"
# KEY of the line; cloudroid-stub pair looks at all of it.
of_line() {
  printf '%s\n' "$line" | sed -n "s/^cloudroid:.*[?&]$1=\([A-Za-z0-9_.:-]*\).*/\1/p"
}
if [ -n "$line" ]; then
  case $line in
    cloudroid://*/?*robot=*code=*) ;;
    *) complain "--pair needs the line that cloudroidctl pair ROBOT prints, which begins with cloudroid://, in single quotes" ;;
  esac
  if [ -z "$key" ]; then key=$(of_line key | tr '_-' '/+'); fi
  if [ -z "$server" ]; then server=${line#cloudroid://} server=wss://${server%%/*}; fi
  if [ -z "$robot" ]; then robot=$(of_line robot); fi
fi
known=${XDG_CONFIG_HOME:-${HOME:-/nowhere}/.config}/cloudroid/servers.pub
# What stands in this archive is what the server signed: before anything of it runs.
umask 022
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for file in MANIFEST MANIFEST.sig server.pub; do
  [ -f "$here/$file" ] && [ ! -h "$here/$file" ] || complain "this archive is not signed: it has no $file; download the stub from the server again"
done
signers=$work/signers
# Who signed the stub of this package that is installed signs the next one, too: the key of another server in the same overlay is good for
# that server's packages, and for those that are not there yet.
case $key in
  '') if [ -s "$share/server.pub" ]; then cat "$share/server.pub"; elif [ -s "$prefix/servers.pub" ]; then cat "$prefix/servers.pub"; elif [ -s "$known" ]; then cat "$known"; else cat "$here/server.pub"; fi ;;
  AAAA*) printf 'cloudroid ssh-ed25519 %s\n' "$key" ;;
  ssh-ed25519\ *) printf 'cloudroid %s\n' "$key" ;;
  *)
    [ -r "$key" ] || complain "--key is neither a key (ssh-ed25519 AAAA...) nor a file: $key"
    sed -n 's/^\(cloudroid \)\{0,1\}\(ssh-ed25519 AAAA[^ ]*\).*/cloudroid \2/p' "$key"
    ;;
esac > "$signers"
[ -s "$signers" ] || complain "$key contains no key (ssh-ed25519 AAAA...)"

# Verifies the list's signature: by OpenSSH 8.1 or later, else by Python, which every robot with launch files has.
verify() {
  if ssh-keygen -Y verify -f "$signers" -I cloudroid -n cloudroid-stub -s "$here/MANIFEST.sig" < "$here/MANIFEST" > /dev/null 2> "$work/said"; then
    return 0
  fi
  # Older ones do not know -Y.
  command -v python3 > /dev/null || {
    if command -v ssh-keygen > /dev/null && ! grep -qi 'option' "$work/said"; then return 1; fi
    complain "no program to verify the signature: sudo apt install openssh-client (8.1 or later) or python3"
  }
  python3 -I - "$signers" "$here/MANIFEST.sig" "$here/MANIFEST" << 'END'
# Ed25519 (RFC 8032, section 5.1.7) over SSH's form of signatures (PROTOCOL.sshsig).
import base64, hashlib, sys

P = 2**255 - 19
ORDER = 2**252 + 27742317777372353535851937790883648493
D = -121665 * pow(121666, P - 2, P) % P


def strings(blob):
    found = []
    while blob:
        end = 4 + int.from_bytes(blob[:4], "big")
        if end > len(blob):
            sys.exit(1)
        found.append(blob[4:end])
        blob = blob[end:]
    return found


def point(encoded):
    y = int.from_bytes(encoded, "little")
    sign, y = y >> 255, y & (1 << 255) - 1
    square = (y * y - 1) * pow(D * y * y + 1, P - 2, P) % P
    x = pow(square, (P + 3) // 8, P)
    if (x * x - square) % P:
        x = x * pow(2, (P - 1) // 4, P) % P
    if len(encoded) != 32 or y >= P or (x * x - square) % P or (x == 0 and sign):
        sys.exit(1)
    x = P - x if x & 1 != sign else x
    return x, y, 1, x * y % P


def add(p, q):
    a, b = (p[1] - p[0]) * (q[1] - q[0]), (p[1] + p[0]) * (q[1] + q[0])
    c, d = 2 * D * p[3] * q[3], 2 * p[2] * q[2]
    e, f, g, h = b - a, d - c, d + c, b + a
    return e * f % P, g * h % P, f * g % P, e * h % P


def times(number, p):
    product = (0, 1, 1, 0)
    while number:
        if number & 1:
            product = add(product, p)
        p, number = add(p, p), number >> 1
    return product


def verified(key, signature, message):
    r, s = signature[:32], int.from_bytes(signature[32:], "little")
    if len(signature) != 64 or s >= ORDER:
        return False
    h = int.from_bytes(hashlib.sha512(r + key + message).digest(), "little") % ORDER
    base = point((4 * pow(5, P - 2, P) % P).to_bytes(32, "little"))
    left, right = times(s, base), add(point(r), times(h, point(key)))
    return all((left[i] * right[2] - right[i] * left[2]) % P == 0 for i in (0, 1))


def packed(*fields):
    return b"".join(len(field).to_bytes(4, "big") + field for field in fields)


signers, signature, signed = (open(path, "rb").read() for path in sys.argv[1:])
try:
    blob = base64.b64decode(b"".join(line for line in signature.split(b"\n") if not line.startswith(b"-----")), validate=True)
    keys = [base64.b64decode(line.split()[2], validate=True) for line in signers.splitlines()]
except (ValueError, IndexError):
    sys.exit(1)
fields = strings(blob[10:]) if blob[:10] == b"SSHSIG\0\0\0\1" else []
if len(fields) != 5 or fields[0] not in keys or fields[1] != b"cloudroid-stub" or fields[3] != b"sha512":
    sys.exit(1)
key, signature = strings(fields[0]), strings(fields[4])
if len(key) != 2 or len(signature) != 2 or key[0] != b"ssh-ed25519" or signature[0] != b"ssh-ed25519":
    sys.exit(1)
message = b"SSHSIG" + packed(fields[1], fields[2], fields[3], hashlib.sha512(signed).digest())
sys.exit(0 if verified(key[1], signature[1], message) else 1)
END
}

if ! verify; then
  if [ "$(sed -n 1p "$here/server.pub")" != "$(sed -n 1p "$signers")" ] && ! grep -qxF "$(sed -n 1p "$here/server.pub")" "$signers"; then
    complain "this archive is signed by another key than the one this robot knows ($(cut -d ' ' -f 2- < "$here/server.pub")): if the server was reinstalled, ask its operator for the key (cloudroidctl stub) and pass it with --key"
  fi
  complain "the signature is not the server's: the archive was changed in transit; download it again"
fi
# All files (x: may be executed), links, and what is neither, as the server listed them.
(
  cd "$here"
  find . -type f -perm -100 ! -path ./MANIFEST ! -path ./MANIFEST.sig -exec sha256sum {} + | sed 's/^/x /'
  find . -type f ! -perm -100 ! -path ./MANIFEST ! -path ./MANIFEST.sig -exec sha256sum {} + | sed 's/^/- /'
  find . -type l -exec sh -c 'for file; do printf "l %s -> " "$file"; readlink "$file"; done' sh {} +
  find . ! -type f ! -type l ! -type d -exec printf '? %s\n' {} \;
) | LC_ALL=C sort > "$work/found"
if ! cmp -s "$work/found" "$here/MANIFEST"; then
  LC_ALL=C comm -3 "$work/found" "$here/MANIFEST" | sed 's/^\t*\([^ ]*\) .* \(\.\/.*\)/  \2/; s/^\t*l /  /' | sort -u | head -n 10 >&2
  complain "these files differ from what the server signed: unpack the archive again into an empty directory"
fi
if [ -z "$key" ] && [ ! -s "$prefix/servers.pub" ] && [ ! -s "$known" ]; then
  echo "install.sh: trusting the key that came with the archive, $(cut -d ' ' -f 2- < "$here/server.pub"); compare it with the key that cloudroidctl stub prints, or pass it with --key" >&2
fi

stub=$here/lib/$package/cloudroid-stub
if ! "$stub" --version > /dev/null 2>&1; then
  complain "$stub does not run on this machine ($(uname -m)): download the stub for its architecture (?arch= or cloudroidctl stub --arch)"
fi
# Before the line is redeemed, which is good for one robot.
if ! "$stub" doctor --share "$here/share/$package" --package "$package" --only ros; then
  $force || complain "nothing was installed: fix this, or install anyway with --force"
fi

if [ -n "$line" ]; then
  "$stub" pair "$line" || complain "nothing was installed: this robot could not be paired"
fi

# What the robot's owner has set in an earlier stub.toml is kept.
settings=$(mktemp)
secret=$(mktemp)
trap 'rm -rf "$work" "$settings" "$secret"' EXIT
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
# KEY FILE: the value that a file sets.
key_of() {
  sed -n "s/^$1 *= *\"\(.*\)\"[^\"]*\$/\1/p" "$2" | head -n 1
}
# The server signs where it is reached and what it shows: an earlier address in plain text, and a certificate that it has
# shown before, are not kept.
offered=$here/share/$package/stub.toml
if [ -z "$server" ] && [ -e "$share/stub.toml" ]; then
  now=$(key_of server "$offered") before=$(key_of server "$settings")
  case $before,$now in
    ws://*,wss://*)
      echo "install.sh: the server now uses TLS: $now instead of $before" >&2
      server=$now
      ;;
  esac
  now=$(key_of fingerprint "$offered") before=$(key_of fingerprint "$settings")
  if [ -z "$fingerprint" ] && [ -n "$now" ] && [ "$now" != "$before" ]; then
    echo "install.sh: the server's certificate is now $now${before:+ instead of $before}" >&2
    fingerprint=$now
  fi
fi
# The line says which certificate counts now.
if [ -n "$line" ] && [ -z "$fingerprint" ] && [ -n "$(key_of fingerprint "$settings")" ]; then
  fingerprint=$(of_line fingerprint)
fi
if [ -n "$robot" ]; then set_key robot "$robot"; fi
if [ -n "$server" ]; then set_key server "$server"; fi
if [ -n "$fingerprint" ]; then set_key fingerprint "$fingerprint"; fi
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
trap 'rm -rf "$work" "$settings" "$secret" "$trial"' EXIT
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
  $force || complain "nothing was installed: fix this, or install anyway with --force"
fi

mkdir -p "$prefix/lib" "$prefix/share"
rm -rf "$lib" "$share.old"
if [ -e "$share" ]; then mv "$share" "$share.old"; fi
cp -R "$here/lib/$package" "$lib"
cp -R "$here/share/$package" "$share"
unregister
if [ $ros = 2 ]; then
  cp -R "$here/share/ament_index" "$prefix/share/"
  find "$index" -type d -exec chmod 0755 {} +
  find "$index" -type f -exec chmod 0644 {} +
  link_types
fi
cp "$here/install.sh" "$share/install.sh"
cp "$here/server.pub" "$share/server.pub"
cat "$settings" > "$share/stub.toml"
# Whatever the archive was unpacked by: programs are 0755, files 0644, and nothing sets a user.
for path in "$lib" "$share"; do
  find "$path" -type d -exec chmod 0755 {} +
  find "$path" -type f -perm -100 -exec chmod 0755 {} +
  find "$path" -type f ! -perm -100 -exec chmod 0644 {} +
done
if [ -s "$secret" ]; then
  # A file of this name that came with the package would keep its rights.
  rm -rf "$share/token"
  (umask 077 && cat "$secret" > "$share/token")
fi
if [ -n "$ca" ]; then cat "$ca" > "$share/ca.pem"; fi
rm -rf "$share.old"
# Further ones may be known already: several servers' stubs share an overlay.
if ! grep -qxF "$(cat "$here/server.pub")" "$prefix/servers.pub" 2> /dev/null; then cat "$here/server.pub" >> "$prefix/servers.pub"; fi
for file in $copied; do cp "$here/$file" "$prefix/$file"; done
replacement=$(printf '%s\n' "$prefix" | sed 's/[&|]/\\&/g')
for file in $setups; do
  sed "s|^_cloudroid_installed=.*|_cloudroid_installed='$replacement'|" "$here/$file" > "$prefix/$file.new"
  mv "$prefix/$file.new" "$prefix/$file"
done
refresh

case ${SHELL:-} in */zsh) setup=setup.zsh ;; */bash) setup=setup.bash ;; *) setup=setup.sh ;; esac
cat << END
Installed in $prefix. Source it after every other setup file, in each shell or at the end of its rc file:

    . $prefix/$setup

To check the installation:  @RUN@ $package cloudroid-stub doctor
To uninstall:               sh $share/install.sh --uninstall
END
