// What programs with Foxglove's own client have in common: a viewer that waits for what it is told.
'use strict';
const assert = require('node:assert');
const { FoxgloveClient } = require('@foxglove/ws-protocol');
const WebSocket = require('ws');

// Milliseconds, longer on a busy machine.
const PATIENCE = Number(process.env.STORY_PATIENCE ?? 60) * 1000;

const check = (what, truth) => { assert(truth, what); console.log(what); };

// Waits for things that are told in any order: what was told before counts, too.
class Told {
  constructor() { this.all = []; this.waiting = []; }
  tell(what) { this.all.push(what); this.waiting.splice(0).forEach((wake) => wake()); }
  async next(wanted) {
    for (;;) {
      const at = this.all.findIndex(wanted);
      if (at >= 0) return this.all.splice(at, 1)[0];
      await new Promise((resolve) => this.waiting.push(resolve));
    }
  }
}

class Viewer {
  // `ros`: how its messages are written, how their definitions are, and what makes a reader of a definition.
  constructor(url, ros) {
    this.ros = ros;
    this.client = new FoxgloveClient({ ws: new WebSocket(url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL, 'foxglove.sdk.v1']) });
    for (const event of ['serverInfo', 'status', 'message', 'serviceCallResponse', 'serviceCallFailure', 'parameterValues', 'connectionGraphUpdate']) {
      this[event] = new Told();
      this.client.on(event, (what) => this[event].tell(what));
    }
    this.channels = new Told();
    this.client.on('advertise', (all) => all.forEach((one) => this.channels.tell(one)));
    this.services = new Told();
    this.client.on('advertiseServices', (all) => all.forEach((one) => this.services.tell(one)));
    this.client.on('error', (error) => { console.error('error', error); process.exit(1); });
  }
  channel(topic) { return this.channels.next((one) => one.topic === topic); }
  service(name) { return this.services.next((one) => one.name === name); }
  async subscribes(topic) {
    const channel = await this.channel(topic);
    assert.equal(channel.encoding, this.ros.encoding);
    assert.equal(channel.schemaEncoding, this.ros.schema);
    const reader = this.ros.reader(channel.schema);
    const id = this.client.subscribe(channel.id);
    return { id, next: async () => {
      const message = await this.message.next((one) => one.subscriptionId === id);
      return { at: message.timestamp, says: reader.readMessage(message.data) };
    } };
  }
  async calls(service, bytes, encoding = this.ros.encoding) {
    const callId = Viewer.calls = (Viewer.calls ?? 0) + 1;
    this.client.sendServiceCallRequest({ serviceId: service.id, callId, encoding, data: new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength) });
    return Promise.race([
      this.serviceCallResponse.next((one) => one.callId === callId),
      this.serviceCallFailure.next((one) => one.callId === callId),
    ]);
  }
  async parameter(name) {
    const id = `get ${name} ${Math.random()}`;
    this.client.getParameters([name], id);
    return (await this.parameterValues.next((one) => one.id === id)).parameters[0];
  }
  async refused(words) {
    const { message } = await this.status.next((one) => one.message.includes(words));
    console.log(`refused: ${message}`);
  }
}

// Runs a program's own part; it ends with `done`.
function runs(main) {
  setTimeout(() => { console.error('it took too long'); process.exit(1); }, PATIENCE).unref();
  main().then(() => { console.log('done'); process.exit(0); }, (error) => { console.error(error); process.exit(1); });
}

module.exports = { Viewer, check, runs };
