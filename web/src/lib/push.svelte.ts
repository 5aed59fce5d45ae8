// A push that is under way: it goes on while other pages are looked at, and ends with this tab.
import { exchanged, Problem } from './api';
import type { Caps, Limits, PushEvent, PushOptions, ServiceDetail } from './types';

/** Limits as they are written in a form: sizes may have a unit. */
type Written<T> = { [name in keyof T]: string | number | undefined };
export type Options = Omit<PushOptions, 'limits' | 'caps'> & { limits?: Written<Limits>; caps?: Written<Caps> };

export interface Step { title: string; began: number; took?: number; end?: 'done' | 'failed' | 'cancelled' }

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
  unchanged = $state(false);
  problem = $state.raw<unknown>();
  cancelled = $state(false);

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
    this.cancelled = false;
    this.#step('sending');
    const stop = new AbortController();
    this.#stop = stop;
    try {
      const query = encodeURIComponent(JSON.stringify(options));
      if (query.length > LONGEST) throw Problem.here(`the options are ${query.length} bytes long, too many for one request`, 'shorten the interface or the parameters');
      // The first word of the daemon ends the sending.
      const gone = (done: number, total: number) => { if (this.steps.length === 1) this.progress = { unit: 'bytes', done, total }; };
      for await (const line of exchanged(`/push?options=${query}`, body, stop.signal, gone)) if (line) this.#take(JSON.parse(line));
      if (!this.done && !this.problem) throw Problem.here('the daemon closed the connection', 'check that it is running, and see its log');
    } catch (error) {
      if (stop.signal.aborted) this.cancelled = true;
      else this.problem = error;
    }
    this.#end(this.cancelled ? 'cancelled' : this.problem === undefined ? 'done' : 'failed');
    this.busy = false;
  }

  #end(end: Step['end'] = 'done'): void {
    const last = this.steps.at(-1);
    if (last && last.took === undefined) {
      last.took = Date.now() - last.began;
      last.end = end;
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
        this.unchanged = event.unchanged ?? false;
        return;
      case 'error':
        this.problem = Problem.of(event.problem);
    }
  }
}

export const push = new Push();
