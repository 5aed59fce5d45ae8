#!/bin/sh
# Runs this node in the cloud, under its own name.
case $0 in */*) here=${0%/*} ;; *) here=. ;; esac
prefix=$here@UP@
exec "$prefix"/lib/'@PACKAGE@'/cloudroid-stub run --package '@PACKAGE@' --node @NODE@ --share "$prefix"/share/'@PACKAGE@' -- "$@"
