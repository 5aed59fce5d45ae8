// A connection into a servant by rosbridge (protocol 2.0), beside its robot: what one may do there is what the policy says.
import { Problem, token } from './api';
import { decode } from './cbor';

type Message = Record<string, unknown>;
type Hears = (message: unknown) => void;

/** How a goal ends (action_msgs/GoalStatus). */
export const CANCELLED = 'was cancelled';
const ENDS: Record<number, string> = { 4: 'succeeded', 5: CANCELLED, 6: 'was aborted' };

export interface Goal {
  /** Told of each feedback. */
  feedback: Hears;
  /** Told once, with how it ended in words. */
  result: (words: string, values: unknown, good: boolean) => void;
  /** Told in place of that where it was not taken. */
  refused: (why: Problem) => void;
}

export interface Hearing {
  /** How messages come: `cbor` for what has many numbers, `preview` with less in pictures and clouds. */
  encoding?: 'none' | 'cbor' | 'preview';
  /** Least time between messages, in milliseconds. */
  pause?: number;
  /** Messages that the daemon keeps for this page; the newest win. */
  keep?: number;
}

/** What to do about what was refused, or has failed, inside. */
function refusal(words: string): Problem {
  if (words.includes('not granted')) return Problem.here(words, 'viewers can listen only: ask an operator to do this, or for a rule that grants it (Access, Policy)');
  if (/no definition|not known|does not exist|not advertised/.test(words)) return Problem.here(words, 'choose one from the lists on this page');
  return Problem.here(words, 'correct the request, and see the node’s messages in the servant’s log');
}

export class Rosbridge {
  readonly #socket: WebSocket;
  readonly #calls = new Map<string, { resolve: (values: unknown) => void; reject: (error: Problem) => void }>();
  readonly #heard = new Map<string, Set<Hears>>();
  readonly #goals = new Map<string, Goal>();
  #number = 0;
  /** Resolves once it is there. */
  readonly ready: Promise<void>;
  /** Told when it is lost, in words. */
  lost: (problem: Problem) => void = () => {};
  /** What the daemon says of it: a Problem where it refuses something. */
  status: (said: string | Problem) => void = () => {};

  constructor(servant: string) {
    const address = `${location.origin.replace(/^http/, 'ws')}/api/v1/servants/${encodeURIComponent(servant)}/inside`;
    // A page can set no header: the token is a subprotocol. A session is shown by its cookie.
    this.#socket = new WebSocket(address, ['rosbridge', ...(token.get() ? [`bearer.${token.get()}`] : [])]);
    this.#socket.binaryType = 'arraybuffer';
    this.ready = new Promise((resolve, reject) => {
      this.#socket.onopen = () => resolve();
      this.#socket.onclose = (event) => {
        const problem = Problem.here(event.reason || 'the connection to the servant was refused or lost', 'you need permission to see its service, and only a few pages can look into a servant at once; reload the page to try again');
        for (const { reject } of this.#calls.values()) reject(problem);
        this.#calls.clear();
        reject(problem);
        this.lost(problem);
      };
    });
    this.#socket.onmessage = ({ data }) => this.#take((typeof data === 'string' ? JSON.parse(data) : decode(data)) as Message);
  }

  #take(message: Message): void {
    const id = message.id as string;
    if (message.op === 'publish') for (const hears of this.#heard.get(message.topic as string) ?? []) hears(message.msg);
    else if (message.op === 'status') this.status(message.level === 'error' ? refusal(String(message.msg)) : String(message.msg));
    else if (message.op === 'action_feedback') this.#goals.get(id)?.feedback(message.values);
    else if (message.op === 'action_result') {
      const goal = this.#goals.get(id);
      this.#goals.delete(id);
      const good = message.result === true && message.status === 4;
      if (message.result !== true && typeof message.values === 'string') goal?.refused(refusal(message.values));
      else goal?.result(ENDS[message.status as number] ?? 'did not finish', message.values, good);
    } else if (message.op === 'service_response') {
      const call = this.#calls.get(id);
      this.#calls.delete(id);
      if (message.result) call?.resolve(message.values);
      else call?.reject(refusal(typeof message.values === 'string' ? message.values : JSON.stringify(message.values)));
    }
  }

  #say(message: Message): void {
    if (this.#socket.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  #id(): string {
    return `page ${(this.#number += 1)}`;
  }

  call<T>(service: string, args: unknown = {}): Promise<T> {
    const id = this.#id();
    return new Promise<T>((resolve, reject) => {
      this.#calls.set(id, { resolve: resolve as (values: unknown) => void, reject });
      this.#say({ op: 'call_service', id, service, args });
    });
  }

  /** Until what is given back is called. At most ten messages a second, the newest, where nothing else is said. */
  hear(topic: string, hears: Hears, { encoding = 'none', pause = 100, keep = 1 }: Hearing = {}): () => void {
    const all = this.#heard.get(topic) ?? new Set();
    this.#heard.set(topic, all.add(hears));
    const id = this.#id();
    this.#say({ op: 'subscribe', id, topic, throttle_rate: pause, queue_length: keep, compression: encoding });
    return () => {
      all.delete(hears);
      this.#say({ op: 'unsubscribe', id, topic });
    };
  }

  publish(topic: string, type: string, msg: unknown): void {
    this.#say({ op: 'advertise', topic, type });
    this.#say({ op: 'publish', topic, msg });
  }

  /** Sends a goal; what is given back cancels it. */
  act(action: string, type: string, goal: unknown, told: Goal): () => void {
    const id = this.#id();
    this.#goals.set(id, told);
    this.#say({ op: 'send_action_goal', id, action, action_type: type, args: goal, feedback: true });
    return () => this.#say({ op: 'cancel_action_goal', id, action });
  }

  close(): void {
    this.lost = () => {};
    this.#socket.close();
  }
}
