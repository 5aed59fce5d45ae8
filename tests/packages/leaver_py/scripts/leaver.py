#!/usr/bin/env python3
"""Leaves before anybody could meet it."""
import sys

print("the map file is missing", file=sys.stderr)
sys.exit(3)
