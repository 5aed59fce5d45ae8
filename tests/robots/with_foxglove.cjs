// All that a viewer does, with Foxglove's own client and readers (npm) inside a servant of sights_py.
// `looks` is refused what changes something. Ends with `done`; where it is told of a status, with what was said.
//
// usage: node with_foxglove.cjs URL acts|looks   (NODE_PATH names where the packages are)
'use strict';
const assert = require('node:assert');
const { parse } = require('@foxglove/rosmsg');
const { MessageReader, MessageWriter } = require('@foxglove/rosmsg-serialization');
const { Viewer, check, runs } = require('./foxglove_viewer.cjs');

const [url, part] = process.argv.slice(2);
const ROS = { encoding: 'ros1', schema: 'ros1msg', reader: (schema) => new MessageReader(parse(schema)) };

async function main() {
  const viewer = new Viewer(url, ROS);
  const info = await viewer.serverInfo.next(() => true);
  check(`the servant of ${info.name}`, info.name.startsWith('rover at sights_py ('));
  for (const can of ['clientPublish', 'services', 'parameters', 'connectionGraph']) assert(info.capabilities.includes(can), can);
  check('ROS 1 is spoken', info.supportedEncodings.includes('ros1'));

  const image = await viewer.subscribes('/sights/image/rgb8');
  const { at, says } = await image.next();
  check('a picture', says.height === 480 && says.encoding === 'rgb8' && says.data.length === 480 * says.step);
  check('heard now', Math.abs(Number(at / 1_000_000n) - Date.now()) < 60_000);
  viewer.client.unsubscribe(image.id);
  const map = await viewer.subscribes('/sights/map');
  check('a map that was latched', (await map.next()).says.info.width === 100);
  const other = new Viewer(url, ROS);
  const same = await other.subscribes('/sights/map');
  check('the map for a second viewer', (await same.next()).says.info.height === 60);
  other.client.close();

  viewer.client.subscribeConnectionGraph();
  const graph = await viewer.connectionGraphUpdate.next(() => true);
  check('the graph', graph.publishedTopics.some((one) => one.name === '/sights/map' && one.publisherIds.includes('/sights'))
    && graph.advertisedServices.some((one) => one.name === '/sights/ping' && one.providerIds.includes('/sights')));

  // What is not there, or not so.
  viewer.client.subscribe(4_000_000);
  await viewer.refused('there is no channel 4000000');
  viewer.client.advertise({ topic: '/sights/say', encoding: 'json', schemaName: 'std_msgs/String' });
  await viewer.refused('encoded as ros1, not json');
  viewer.client.advertise({ topic: '/elsewhere', encoding: 'ros1', schemaName: 'no_such/Type' });
  await viewer.refused(part === 'looks' ? 'publish:/elsewhere is not granted' : 'no_such/Type');
  viewer.client.sendMessage(77, new Uint8Array(4));
  await viewer.refused('channel 77 is not advertised by this viewer');
  const ping = await viewer.service('/sights/ping');
  check('its type', ping.type === 'std_srvs/Trigger');
  const nowhere = await viewer.calls({ id: 4_000_000 }, new Uint8Array(0));
  check('no such service', nowhere.message.includes('there is no service 4000000'));
  const json = await viewer.calls(ping, new Uint8Array(0), 'json');
  check('requests in JSON', json.message.includes('encoded as ros1'));

  const say = new MessageWriter(parse('string data'));
  const saying = viewer.client.advertise({ topic: '/sights/say', encoding: 'ros1', schemaName: 'std_msgs/String' });
  const speak = (words) => viewer.client.sendMessage(saying, say.writeMessage({ data: words }));
  if (part === 'looks') {
    await viewer.refused('publish:/sights/say is not granted');
    speak('unheard');
    const refused = await viewer.calls(ping, new Uint8Array(0));
    check('no call', refused.message.includes('call:/sights/ping is not granted'));
    viewer.client.setParameters([{ name: '/sights/gain', value: 9 }], 'set');
    await viewer.refused('is not granted');
    viewer.client.getParameters(['/sights/gain'], 'get');
    await viewer.refused('is not granted');
  } else {
    const said = await viewer.subscribes('/sights/said');
    const hears = said.next();
    const again = setInterval(() => speak('by a viewer'), 100);
    check('what it said comes back', (await hears).says.data === 'by a viewer');
    clearInterval(again);
    const response = await viewer.calls(ping, new Uint8Array(0));
    const answer = new MessageReader(parse(ping.response.schema)).readMessage(response.data);
    check('a call', answer.success === true && answer.message === 'pong');
    const torn = await viewer.calls(ping, new Uint8Array([1, 2, 3]));
    check('a torn request', torn.message.includes('not a request of std_srvs/Trigger'));
    viewer.client.sendMessage(saying, new Uint8Array([9, 0, 0, 0, 1]));
    await viewer.refused('/sights/say: not a std_msgs/String');
    check('a whole number', (await viewer.parameter('/sights/gain')).value === 2);
    const scale = await viewer.parameter('/sights/scale');
    check('a float that is whole', scale.value === 2 && scale.type === 'float64');
    viewer.client.setParameters([{ name: '/sights/scale', value: 3, type: 'float64' }, { name: '/sights/names', value: ['a', 'b'] }], 'set');
    await viewer.parameterValues.next((one) => one.id === 'set');
    const now = await viewer.parameter('/sights/scale');
    check('a float that was set', now.value === 3 && now.type === 'float64');
    check('a list', (await viewer.parameter('/sights/names')).value.join() === 'a,b');
  }
  viewer.client.close();
}

runs(main);
