// All that a robot does of ROS 2, with roslib 2 (npm) against the herald. Ends with `done`.
//
// usage: node ros2_with_roslib.mjs URL   (NODE_PATH names where roslib-of-ros2 is)
import assert from 'node:assert';
import { join } from 'node:path';
import { pathToFileURL } from 'node:url';

const place = join(process.env.NODE_PATH, 'roslib-of-ros2/dist/RosLib.js');
const { Action, Param, Ros, Service, Topic } = await import(pathToFileURL(place));
// Milliseconds, longer on a busy machine.
const PATIENCE = Number(process.env.STORY_PATIENCE ?? 60) * 1000;
setTimeout(() => { console.error('it took too long'); process.exit(1); }, PATIENCE).unref();

const check = (what, truth) => { assert(truth, what); console.log(what); };
const call = (service, request) => new Promise((resolve, reject) => service.callService(request, resolve, reject));
// Of an object's method that takes what is to be called with its answer, and what with its failure.
const asked = (ask) => new Promise((resolve, reject) => ask(resolve, (why) => reject(new Error(String(why)))));
const next = (topic) => new Promise((resolve) => {
  topic.subscribe((message) => { topic.unsubscribe(); resolve(message); });
});
// What comes of a goal.
const goal = (action, wanted) => {
  const feedback = [];
  return asked((done, failed) => action.sendGoal(wanted, (result) => done({ result, feedback }), (one) => feedback.push(one), failed));
};

const ros = new Ros({});
const connected = asked((done, failed) => { ros.on('connection', done); ros.on('error', failed); });
await ros.connect(process.argv[2]);
await connected;

const talk = new Topic({ ros, name: '/talk', messageType: 'std_msgs/String' });
const said = next(talk);
talk.publish({ data: 'to myself' });
check('a topic both ways', (await said).data === 'to myself');
const name = new Topic({ ros, name: '/name', messageType: 'std_msgs/msg/String' });
const greetings = new Topic({ ros, name: '/greeting', messageType: 'herald_msgs/msg/Greeting' });
// What the node says before it hears of the subscription is lost, as in every ROS.
const greeting = next(greetings);
const named = setInterval(() => name.publish({ data: 'crowd' }), 100);
const heard = await greeting;
clearInterval(named);
check("a node's topic", heard.text === 'Hello, crowd' && heard.stamp.sec > 1_500_000_000 && heard.at[1].x === 1);
// The node hears of the new subscription in its time, and keeps nothing for it; it may still greet the crowd.
const binary = new Promise((resolve) => {
  const topic = new Topic({ ros, name: '/greeting', messageType: 'herald_msgs/msg/Greeting', compression: 'cbor' });
  topic.subscribe((message) => {
    if (message.text !== 'Hello, again') return;
    topic.unsubscribe();
    resolve(message);
  });
});
const again = setInterval(() => name.publish({ data: 'again' }), 100);
check("a node's topic in CBOR", (await binary).wide === 'HELLO, AGAIN');
clearInterval(again);

const greet = new Service({ ros, name: '/greet', serviceType: 'herald_msgs/srv/Greet' });
const greeted = await call(greet, { name: 'Jürgen' });
check("a node's service", greeted.greeting.wide === 'HELLO, JÜRGEN' && greeted.known === false);
const lamp = new Service({ ros, name: '/lamp', serviceType: 'std_srvs/srv/SetBool' });
lamp.advertise((request, response) => {
  response.success = request.data;
  response.message = 'lit';
  return true;
});
while (!(await asked((done, failed) => ros.getServices(done, failed))).includes('/lamp'));
const caller = new Service({ ros, name: '/lamp', serviceType: 'std_srvs/SetBool' });
const answer = await call(caller, { data: true });
check('a service of its own', answer.success === true && answer.message === 'lit');

const count = new Action({ ros, name: '/count', actionType: 'herald_msgs/action/Count' });
const { result, feedback } = await goal(count, { to: 4 });
check("an action's result", result.counted.join() === '1,2,3,4');
check("an action's feedback", feedback.map((one) => one.at).join() === '1,2,3,4');
const servers = await asked((done, failed) => ros.getActionServers(done, failed));
check('its server', servers.includes('/count'));

// An action of its own, which it uses, and cancels once.
const dance = new Action({ ros, name: '/dance', actionType: 'herald_msgs/action/Count' });
dance.advertise((wanted, id) => {
  if (wanted.to > 2) return;
  dance.sendFeedback(id, { at: 1 });
  dance.setSucceeded(id, { counted: [1, wanted.to] });
}, (id) => dance.setCanceled(id, { counted: [9] }));
const other = new Action({ ros, name: '/dance', actionType: 'herald_msgs/action/Count' });
const danced = await goal(other, { to: 2 });
check('an action of its own', danced.result.counted.join() === '1,2' && danced.feedback[0].at === 1);
const given_up = await asked((done, failed) => {
  const id = other.sendGoal({ to: 3 }, failed, () => {}, done);
  setTimeout(() => other.cancelGoal(id), 500);
});
check('cancelled', given_up.includes('9'));

const parameter = new Param({ ros, name: '/herald:salutation' });
check('a parameter', await asked((done, failed) => parameter.get(done, failed)) === 'Hello');
await asked((done, failed) => parameter.set('Hail', done, failed));
check('a parameter set', (await call(greet, { name: 'Jürgen' })).greeting.text === 'Hail, Jürgen');
const missing = new Param({ ros, name: '/herald:nothing' });
const why = await new Promise((resolve, reject) => missing.get(reject, resolve));
check('one that is not there', why.includes('no parameter nothing'));
const clock = new Service({ ros, name: '/rosapi/get_time', serviceType: 'rosapi_msgs/srv/GetTime' });
check('time', (await call(clock, {})).time.sec > 1_500_000_000);
console.log('done');
ros.close();
process.exit(0);
