# Runs as root inside an install container: installs the packages of /cloudroid/debs in the order of
# /cloudroid/order, then adds the files of /cloudroid/extras.tar that are not there yet.
set -eu
cd /
if [ -s /cloudroid/order ]; then
    # Without fsync after each file: the layer is packed and synced as a whole.
    xargs dpkg --force-unsafe-io --force-confdef --force-confold --install < /cloudroid/order
fi
if [ -e /cloudroid/extras.tar ]; then
    tar --extract --file /cloudroid/extras.tar --directory / --skip-old-files --no-same-owner
fi
