// A push that is under way: it goes on while other pages are looked at, and ends with this tab.
import { fetched, lines, Problem } from './api';
import type { ServiceDetail } from './types';

export interface Options {
  name?: string;
  apt?: string;
  launch?: string;
  nodes?: string[];
  params?: Record<string, unknown>;
  args?: Record<string, string>;
  remaps?: Record<string, string>;
  interface?: string;
  map?: Record<string, string>;
  with?: string[];
  base?: string;
  limits?: Record<string, string | number | undefined>;
  caps?: { cpus?: number; memory?: string };
  grants?: { devices: string[]; volumes: { source: string; target: string }[]; egress: string[] };
  shared?: { min: number; max: number; idempotent: boolean; replicas: number; calls: number };
  rollout?: { canary?: string; bound: number; samples: number; deadline?: number; promote_after?: number };
  sla?: { rrt?: string; max_rrt?: string };
  stateful?: boolean;
  stateless?: boolean;
  source?: string;
}

type PushEvent =
  | { type: 'step'; title: string }
  | { type: 'log'; line: string }
  | { type: 'progress'; unit: string; done: number; total?: number }
  | { type: 'warning'; message: string }
  | { type: 'done'; service: ServiceDetail; took: number }
  | { type: 'error'; problem: { status: number; title: string; detail: string; next?: string } };

export interface Step { title: string; began: number; took?: number; failed?: boolean }

/** Lines of the build log that are kept. */
const KEPT = 5000;
/** The longest query that HTTP servers take. */
const LONGEST = 60_000;

class Push {
  source = $state('');
  busy = $state(false);
  steps = $state<Step[]>([]);
  progress = $state.raw<{ unit: string; done: number; total?: number }>();
  warnings = $state<string[]>([]);
  log = $state.raw<{ number: number; line: string }[]>([]);
  done = $state.raw<ServiceDetail>();
  problem = $state.raw<unknown>();

  #stop: AbortController | undefined;
  #come: { number: number; line: string }[] = [];
  #number = 0;
  #frame = 0;

  cancel(): void {
    this.#stop?.abort();
  }

  async start(options: Options, body: Blob | undefined): Promise<void> {
    this.source = options.source ?? '';
    this.busy = true;
    this.steps = [];
    this.progress = undefined;
    this.warnings = [];
    this.log = [];
    this.#come = [];
    this.done = undefined;
    this.problem = undefined;
    this.#step('sending');
    const stop = new AbortController();
    this.#stop = stop;
    try {
      const query = encodeURIComponent(JSON.stringify(options));
      if (query.length > LONGEST) throw new Problem(0, '', `the options are ${query.length} bytes long, which is too much`, 'shorten the interface or the parameters');
      const answer = await fetched(`/push?options=${query}`, { method: 'POST', signal: stop.signal, ...(body ? { body } : {}) });
      for await (const line of lines(answer)) if (line) this.#take(JSON.parse(line));
      if (!this.done && !this.problem) throw new Problem(0, '', 'the daemon broke off', 'see its log, and whether it runs');
    } catch (error) {
      this.problem = stop.signal.aborted ? new Problem(0, '', 'cancelled; nothing was published', '') : error;
    }
    this.#end(this.problem !== undefined);
    this.busy = false;
  }

  #end(failed = false): void {
    const last = this.steps.at(-1);
    if (last && last.took === undefined) {
      last.took = Date.now() - last.began;
      last.failed = failed;
    }
    this.progress = undefined;
  }

  #step(title: string): void {
    this.#end();
    this.steps.push({ title, began: Date.now() });
  }

  #take(event: PushEvent): void {
    switch (event.type) {
      case 'step':
        return this.#step(event.title);
      case 'progress':
        this.progress = event;
        return;
      case 'warning':
        this.warnings.push(event.message);
        return;
      case 'log':
        this.#come.push({ number: (this.#number += 1), line: event.line });
        this.#frame ||= requestAnimationFrame(() => {
          this.#frame = 0;
          this.log = [...this.log, ...this.#come].slice(-KEPT);
          this.#come = [];
        });
        return;
      case 'done':
        this.done = event.service;
        return;
      case 'error':
        this.problem = new Problem(event.problem.status, event.problem.title, event.problem.detail, event.problem.next ?? '');
    }
  }
}

export const push = new Push();
