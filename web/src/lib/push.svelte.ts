// A push that is looked at: one that this tab has sent, or another. Once it is sent, it goes on without the tab.
import { exchanged, fetched, lines, Problem, sent } from './api';
import type { Caps, Limits, PushEvent, PushOptions, PushStatus, ServiceDetail, Underlay } from './types';

/** Limits as they are written in a form: sizes may have a unit. */
type Written<T> = { [name in keyof T]: string | number | undefined };
export type Options = Omit<PushOptions, 'limits' | 'caps'> & { limits?: Written<Limits>; caps?: Written<Caps> };

export interface Step {
  title: string;
  began: number;
  took?: number;
  /** What it took the last time. */
  last?: number;
  end?: 'done' | 'failed' | 'cancelled';
}

/** Lines of the build log that are kept. */
const KEPT = 5000;
/** The kind of problem that a cancelled push ends with. */
const CANCELLED = 'urn:cloudroid:push-cancelled';
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
  /** What was pushed from elsewhere for others to stand on. */
  underlay = $state.raw<Underlay>();
  unchanged = $state(false);
  problem = $state.raw<unknown>();
  cancelled = $state(false);
  /** Its number, once the daemon has named it. */
  number = $state<number>();
  /** Whether it goes on without this tab. */
  accepted = $state(false);
  /** Why it was not cancelled. */
  kept = $state.raw<unknown>();

  #stop: AbortController | undefined;
  #come: { number: number; line: string }[] = [];
  #number = 0;
  #frame = 0;
  /** Whether it is looked at from some time on. */
  #late = false;

  /** Cancels it at the daemon; before it is sent, by not sending the rest. */
  async cancel(): Promise<void> {
    this.kept = undefined;
    if (!this.accepted) this.#stop?.abort();
    if (this.number === undefined) return;
    try {
      await sent('DELETE', `/pushes/${this.number}`);
    } catch (error) {
      // One that was not accepted has ended by itself.
      if (this.accepted) this.kept = error;
    }
  }

  async start(options: Options, body: Blob | undefined): Promise<void> {
    const query = encodeURIComponent(JSON.stringify(options));
    await this.#look(options.source ?? '', 'sending', (stop) => {
      if (query.length > LONGEST) throw Problem.here(`the options are ${query.length} bytes long, too many for one request`, 'shorten the interface or the parameters');
      // The first word of the daemon ends the sending.
      const gone = (done: number, total: number) => { if (this.steps.length === 1) this.progress = { unit: 'bytes', done, total }; };
      const placed = (location: string) => { this.number = Number(location.split('/').pop()) || undefined; };
      return exchanged(`/push?options=${query}`, body, stop, gone, placed);
    });
  }

  /** Shows a push that somebody has sent from elsewhere, or earlier. */
  async follow(other: PushStatus): Promise<void> {
    this.#stop?.abort();
    await this.#look(other.source, '', async function* (stop) {
      yield* lines(await fetched(`/pushes/${other.number}/output?follow=true`, { signal: stop }));
    }, other.number);
  }

  async #look(source: string, first: string, told: (stop: AbortSignal) => AsyncGenerator<string>, number?: number): Promise<void> {
    this.source = source;
    this.busy = true;
    this.number = number;
    this.accepted = this.#late = number !== undefined;
    this.kept = undefined;
    this.steps = [];
    this.progress = undefined;
    this.warnings = [];
    this.log = [];
    this.#come = [];
    this.done = undefined;
    this.underlay = undefined;
    this.problem = undefined;
    this.cancelled = false;
    if (first) this.#step(first);
    const stop = new AbortController();
    this.#stop = stop;
    try {
      for await (const line of told(stop.signal)) {
        // Another push is looked at by now.
        if (this.#stop !== stop) return;
        if (line) this.#take(JSON.parse(line));
      }
      if (!this.done && !this.underlay && !this.problem && !this.cancelled) throw Problem.here('the daemon closed the connection', this.accepted ? 'see in the list of pushes what became of this one' : 'check that it is running, and see its log');
    } catch (error) {
      if (this.#stop !== stop) return;
      if (stop.signal.aborted) this.cancelled = true;
      else this.problem = error;
    }
    this.#end(this.cancelled ? 'cancelled' : this.problem === undefined ? 'done' : 'failed');
    this.busy = false;
  }

  #end(end: Step['end'] = 'done'): void {
    const last = this.steps.at(-1);
    if (last && !last.end) {
      const took = Date.now() - last.began;
      // What was over before it was looked at comes at once.
      if (!this.#late || took >= 1000) last.took = took;
      last.end = end;
    }
    this.progress = undefined;
  }

  #step(title: string, last?: number): void {
    this.#end();
    this.steps.push({ title, began: Date.now(), ...(last === undefined ? {} : { last }) });
  }

  #take(event: PushEvent): void {
    switch (event.type) {
      case 'accepted':
        this.number = event.number;
        this.accepted = true;
        return;
      case 'step':
        return this.#step(event.title, event.last_took);
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
      case 'underlay':
        this.underlay = event.underlay;
        this.unchanged = event.unchanged ?? false;
        return;
      case 'error':
        if (event.problem.type === CANCELLED) this.cancelled = true;
        else this.problem = Problem.of(event.problem);
    }
  }
}

export const push = new Push();
