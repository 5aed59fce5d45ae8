# Runs as root inside an install container: installs packages in the steps of /cloudroid/steps, then adds the files of
# /cloudroid/extras.tar that are not there yet.
set -eu
cd /
# Without fsync after each file: the layer is packed and synced as a whole.
dpkg="dpkg --force-unsafe-io --force-confdef --force-confold"
for list in /cloudroid/steps/*.unpack; do
    configure=${list%.unpack}.configure
    if [ -s "$configure" ]; then
        xargs $dpkg --unpack < "$list"
        # Whatever these need is configured with them.
        xargs $dpkg --force-configure-any --configure < "$configure"
    elif [ -s "$list" ]; then
        xargs $dpkg --install < "$list"
    fi
done
$dpkg --configure --pending
if [ -e /cloudroid/extras.tar ]; then
    tar --extract --file /cloudroid/extras.tar --directory / --skip-old-files --no-same-owner
fi
