// All that a viewer does of ROS 2, with Foxglove's own client and readers (npm) inside a servant of the herald, whose robot says its name and
// shows a square all the time. `looks` is refused what changes something. Ends with `done`; where it is told of a status, with what was said.
//
// usage: node ros2_with_foxglove.cjs URL acts|looks   (NODE_PATH names where the packages are)
'use strict';
const assert = require('node:assert');
const { CdrReader } = require('@foxglove/cdr');
const { parse } = require('@foxglove/rosmsg');
const { MessageReader, MessageWriter } = require('@foxglove/rosmsg2-serialization');
const { Viewer, check, runs } = require('./foxglove_viewer.cjs');

const [url, part] = process.argv.slice(2);
const definition = (schema) => parse(schema, { ros2: true });
const ROS = { encoding: 'cdr', schema: 'ros2msg', reader: (schema) => new MessageReader(definition(schema)) };

// The reader has no wide strings: of a greeting what is before its own.
function greeting(bytes) {
  const reader = new CdrReader(bytes);
  return { sec: reader.int32(), nanosec: reader.uint32(), manner: reader.uint8(), text: reader.string() };
}

async function main() {
  const viewer = new Viewer(url, ROS);
  const info = await viewer.serverInfo.next(() => true);
  check(`the servant of ${info.name}`, info.name.startsWith('rover at herald ('));
  for (const can of ['clientPublish', 'services', 'parameters', 'connectionGraph']) assert(info.capabilities.includes(can), can);
  check('ROS 2 is spoken', info.supportedEncodings.join() === 'cdr');

  const square = await viewer.subscribes('/square');
  const { at, says } = await square.next();
  check('a square', says.header.frame_id === 'floor' && says.polygon.points.length === 4 && says.polygon.points[2].y === 1.5);
  check('heard now', Math.abs(Number(at / 1_000_000n) - Date.now()) < 60_000);
  viewer.client.unsubscribe(square.id);
  const names = await viewer.subscribes('/name');
  check('what its robot says', (await names.next()).says.data === 'rover');
  const greetings = await viewer.channel('/greeting');
  const fields = definition(greetings.schema)[0].definitions.filter((field) => !field.isConstant).map((field) => field.name);
  check('its definition', greetings.schemaName === 'herald_msgs/msg/Greeting' && fields.join() === 'stamp,manner,text,wide,at');
  const hears = viewer.client.subscribe(greetings.id);
  const said = await viewer.message.next((one) => one.subscriptionId === hears);
  const { sec, manner, text } = greeting(said.data);
  check('what the node says', text === 'Hello, rover' && manner === 1 && sec > 1_500_000_000);

  viewer.client.subscribeConnectionGraph();
  const graph = await viewer.connectionGraphUpdate.next(() => true);
  check('the graph', graph.publishedTopics.some((one) => one.name === '/greeting' && one.publisherIds.includes('/herald'))
    && graph.advertisedServices.some((one) => one.name === '/greet' && one.providerIds.includes('/herald')));

  viewer.client.advertise({ topic: '/name', encoding: 'ros1', schemaName: 'std_msgs/msg/String' });
  await viewer.refused('encoded as cdr, not ros1');
  const greet = await viewer.service('/greet');
  check('its type', greet.type === 'herald_msgs/srv/Greet' && greet.request.schemaEncoding === 'ros2msg');
  const request = new MessageWriter(definition(greet.request.schema)).writeMessage({ name: 'viewer' });
  const writer = new MessageWriter(definition('string data'));
  const saying = viewer.client.advertise({ topic: '/name', encoding: 'cdr', schemaName: 'std_msgs/msg/String' });
  const speak = (words) => viewer.client.sendMessage(saying, writer.writeMessage({ data: words }));
  if (part === 'looks') {
    await viewer.refused('publish:/name is not granted');
    speak('unheard');
    const refused = await viewer.calls(greet, request);
    check('no call', refused.message.includes('call:/greet is not granted'));
    viewer.client.setParameters([{ name: '/herald.salutation', value: 'Hail' }], 'set');
    await viewer.refused('is not granted');
  } else {
    const again = setInterval(() => speak('viewer'), 100);
    await viewer.message.next((one) => one.subscriptionId === hears && greeting(one.data).text === 'Hello, viewer');
    check('what it said is answered', true);
    clearInterval(again);
    const answer = greeting((await viewer.calls(greet, request)).data);
    check('a call', answer.text === 'Hello, viewer');
    const torn = await viewer.calls(greet, new Uint8Array([0, 1, 0, 0, 9]));
    check('a torn request', torn.message.includes('not a request of herald_msgs/srv/Greet'));
    viewer.client.sendMessage(saying, new Uint8Array([0, 1, 0, 0, 9, 0, 0, 0, 1]));
    await viewer.refused('/name: not a std_msgs/msg/String');
    check('a text', (await viewer.parameter('/herald.salutation')).value === 'Hello');
    viewer.client.setParameters([{ name: '/herald.salutation', value: 'Hail' }, { name: '/herald.volumes', value: [4, 5] }], 'set');
    await viewer.parameterValues.next((one) => one.id === 'set');
    check('a text that was set', (await viewer.parameter('/herald.salutation')).value === 'Hail');
    check('a list', (await viewer.parameter('/herald.volumes')).value.join() === '4,5');
    check('set in the node', greeting((await viewer.calls(greet, request)).data).text === 'Hail, viewer');
    viewer.client.setParameters([{ name: '/herald.salutation', value: 'Hello' }], 'set back');
    await viewer.parameterValues.next((one) => one.id === 'set back');
  }
  viewer.client.close();
}

runs(main);
