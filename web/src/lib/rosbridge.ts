// A connection to a robot's servant by rosbridge (protocol 2.0), as one more client of that robot.
import { Problem, token } from './api';

type Message = Record<string, unknown>;

export interface Answer { result: boolean; values: unknown }

export class Rosbridge {
  readonly #socket: WebSocket;
  readonly #calls = new Map<string, { resolve: (values: unknown) => void; reject: (error: Problem) => void }>();
  readonly #heard = new Map<string, (message: unknown) => void>();
  #number = 0;
  /** Resolves once it is there. */
  readonly ready: Promise<void>;
  /** Told when it is lost, in words. */
  lost: (problem: Problem) => void = () => {};
  /** What the daemon says of it. */
  status: (words: string) => void = () => {};

  constructor(service: string, robot: string) {
    const address = `${location.origin.replace(/^http/, 'ws')}/${encodeURIComponent(service)}?robot=${encodeURIComponent(robot)}`;
    // A page can set no header: the token is a subprotocol. A session is shown by its cookie.
    this.#socket = new WebSocket(address, ['rosbridge', ...(token.get() ? [`bearer.${token.get()}`] : [])]);
    this.ready = new Promise((resolve, reject) => {
      this.#socket.onopen = () => resolve();
      this.#socket.onclose = (event) => {
        const problem = new Problem(0, '', event.reason || 'the connection to the servant was refused or lost', `who you are must be allowed to connect to ${service} as ${robot}; load the page again to try once more`);
        for (const { reject } of this.#calls.values()) reject(problem);
        this.#calls.clear();
        reject(problem);
        this.lost(problem);
      };
    });
    this.#socket.onmessage = (event) => this.#take(JSON.parse(event.data));
  }

  #take(message: Message): void {
    if (message.op === 'publish') this.#heard.get(message.topic as string)?.(message.msg);
    else if (message.op === 'status') this.status(String(message.msg));
    else if (message.op === 'service_response') {
      const call = this.#calls.get(message.id as string);
      this.#calls.delete(message.id as string);
      if (message.result) call?.resolve(message.values);
      else call?.reject(new Problem(0, '', typeof message.values === 'string' ? message.values : JSON.stringify(message.values), ''));
    }
  }

  #say(message: Message): void {
    this.#socket.send(JSON.stringify(message));
  }

  call<T>(service: string, args: unknown = {}): Promise<T> {
    const id = `page ${(this.#number += 1)}`;
    return new Promise<T>((resolve, reject) => {
      this.#calls.set(id, { resolve: resolve as (values: unknown) => void, reject });
      this.#say({ op: 'call_service', id, service, args });
    });
  }

  /** At most ten messages a second, the newest. */
  hear(topic: string, heard: (message: unknown) => void): () => void {
    this.#heard.set(topic, heard);
    const id = `page ${(this.#number += 1)}`;
    this.#say({ op: 'subscribe', id, topic, throttle_rate: 100, queue_length: 1 });
    return () => {
      this.#heard.delete(topic);
      if (this.#socket.readyState === WebSocket.OPEN) this.#say({ op: 'unsubscribe', id, topic });
    };
  }

  publish(topic: string, type: string, msg: unknown): void {
    this.#say({ op: 'advertise', topic, type });
    this.#say({ op: 'publish', topic, msg });
  }

  close(): void {
    this.lost = () => {};
    this.#socket.close();
  }
}

export interface Definition { type: string; fieldnames: string[]; fieldtypes: string[]; fieldarraylen: number[]; examples: string[] }

const PLAIN: Record<string, unknown> = { string: '', bool: false, time: { secs: 0, nsecs: 0 }, duration: { secs: 0, nsecs: 0 } };

/** A message with nothing in it, of definitions as rosapi gives them: the first is its own. */
export function blank(definitions: Definition[], type = definitions[0]?.type): unknown {
  const own = definitions.find((one) => one.type === type);
  if (!own) return PLAIN[type ?? ''] ?? 0;
  return Object.fromEntries(own.fieldnames.map((name, index) => {
    const length = own.fieldarraylen[index] ?? -1;
    const of = own.fieldtypes[index] ?? '';
    const one = () => (definitions.some((other) => other.type === of) ? blank(definitions, of) : PLAIN[of] ?? 0);
    return [name, length === -1 ? one() : Array.from({ length: Math.max(length, 0) }, one)];
  }));
}
