#!/bin/sh
# Not outsourced: becomes the original, the next of this name that is installed.
case $0 in */*) here=${0%/*} ;; *) here=. ;; esac
prefix=$here@UP@
exec "$prefix"/lib/'@PACKAGE@'/cloudroid-stub exec-original --package '@PACKAGE@' --node @NODE@ --share "$prefix"/share/'@PACKAGE@' -- "$@"
