// All that a robot does, with roslib (npm) against rosbridge_fixture. Prints `end my servant` and connects to a new one;
// ends with `done`.
//
// usage: node with_roslib.cjs URL   (NODE_PATH names where roslib is)
'use strict';
const assert = require('node:assert');
const ROSLIB = require('roslib');

// Milliseconds, longer on a busy machine.
const PATIENCE = Number(process.env.STORY_PATIENCE ?? 60) * 1000;
setTimeout(() => { console.error('it took too long'); process.exit(1); }, 3 * PATIENCE).unref();

const check = (what, truth) => { assert(truth, what); console.log(what); };
const call = (service, request) =>
  new Promise((resolve, reject) => service.callService(request, resolve, reject));
// The next message of a topic that it was not subscribed to.
const next = (topic) => new Promise((resolve) => {
  topic.subscribe((message) => { topic.unsubscribe(); resolve(message); });
});

async function main(url) {
  const ros = new ROSLIB.Ros({ url });
  await new Promise((resolve, reject) => { ros.on('connection', resolve); ros.on('error', reject); });

  const talk = new ROSLIB.Topic({ ros, name: '/talk', messageType: 'std_msgs/String' });
  const said = next(talk);
  talk.publish({ data: 'to myself' });
  check('a topic both ways', (await said).data === 'to myself');
  const listener = new ROSLIB.Topic({ ros, name: '/listener', messageType: 'std_msgs/String' });
  check("a node's topic", (await next(listener)).data === 'Hello, World');
  const binary = new ROSLIB.Topic({ ros, name: '/listener', messageType: 'std_msgs/String', compression: 'cbor' });
  check("a node's topic in CBOR", (await next(binary)).data === 'Hello, World');

  const adder = new ROSLIB.Service({ ros, name: '/add_two_ints', serviceType: 'rospy_tutorials/AddTwoInts' });
  check("a node's service", (await call(adder, { a: 40, b: 2 })).sum === 42);
  const lamp = new ROSLIB.Service({ ros, name: '/lamp', serviceType: 'std_srvs/SetBool' });
  lamp.advertise((request, response) => {
    response.success = request.data;
    response.message = 'lit';
    return true;
  });
  for (;;) {
    const services = await new Promise((resolve, reject) => ros.getServices(resolve, reject));
    if (services.includes('/lamp')) break;
  }
  const caller = new ROSLIB.Service({ ros, name: '/lamp', serviceType: 'std_srvs/SetBool' });
  const answer = await call(caller, { data: true });
  check('a service of its own', answer.success === true && answer.message === 'lit');

  const actionClient = new ROSLIB.ActionClient({
    ros, serverName: '/fibonacci', actionName: 'actionlib_tutorials/FibonacciAction',
  });
  const goal = new ROSLIB.Goal({ actionClient, goalMessage: { order: 5 } });
  const feedback = new Promise((resolve) => goal.once('feedback', resolve));
  const result = new Promise((resolve) => goal.on('result', resolve));
  goal.send();
  check("an action's feedback", (await feedback).sequence[2] === 1);
  check("an action's result", (await result).sequence.join() === '0,1,1,2,3,5,8');

  const parameter = new ROSLIB.Param({ ros, name: '/with_roslib/word' });
  await new Promise((resolve) => parameter.set({ of: ['many', 1, 2.5] }, resolve));
  const value = await new Promise((resolve) => parameter.get(resolve));
  check('a parameter', JSON.stringify(value) === '{"of":["many",1,2.5]}');
  const clock = new ROSLIB.Service({ ros, name: '/rosapi/get_time', serviceType: 'rosapi/GetTime' });
  check('time', (await call(clock, {})).time.secs > 1_500_000_000);
  const tf = new ROSLIB.TFClient({ ros, fixedFrame: 'world' });
  const transform = await new Promise((resolve) => tf.subscribe('turtle1', resolve));
  check('a transform', transform.rotation.w === 1);

  // It does not connect again by itself; topics do subscribe again once it has.
  const lost = new Promise((resolve) => ros.once('close', resolve));
  console.log('end my servant');
  await lost;
  check('lost', !ros.isConnected);
  const back = new Promise((resolve) => ros.once('connection', resolve));
  ros.connect(url);
  await back;
  const anew = new ROSLIB.Topic({ ros, name: '/listener', messageType: 'std_msgs/String' });
  check('heard again', (await next(anew)).data === 'Hello, World');
  console.log('done');
  ros.close();
  process.exit(0);
}

main(process.argv[2]).catch((error) => { console.error(error); process.exit(1); });
