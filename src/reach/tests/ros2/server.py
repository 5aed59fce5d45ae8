"""A discovery server, `server.py PLACE ADDRESS`: Fast DDS makes a participant one by a profile. A line of JSON says that it is there."""

import json
import os
import sys
import tempfile

import rclpy

PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
<participant profile_name="server" is_default_profile="true"><rtps>
<prefix>44.53.%02x.5f.45.50.52.4f.53.49.4d.41</prefix>
<builtin>
<discovery_config><discoveryProtocol>SERVER</discoveryProtocol></discovery_config>
<metatrafficUnicastLocatorList><locator><udpv4><address>%s</address><port>%d</port></udpv4></locator></metatrafficUnicastLocatorList>
</builtin>
</rtps></participant>
</profiles></dds>
"""

place, address = int(sys.argv[1]), sys.argv[2]
with tempfile.NamedTemporaryFile('w', suffix='.xml') as profile:
    profile.write(PROFILE % (place, address, 11811 + place))
    profile.flush()
    # Read when the first participant is made.
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = profile.name
    rclpy.init()
    node = rclpy.create_node('server')
print(json.dumps(['ready']), flush=True)
sys.stdin.read()
