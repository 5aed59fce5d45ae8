// What is so now: the daemon's stream of events (SSE), read by fetch because EventSource cannot show a token. Only a page that
// is looked at listens.
import { fetched, lines, Problem } from './api';
import { rememberMachine, rememberServants } from './history';
import type { BackOff, Event, Machine, Served, ServiceSummary, Update } from './types';

const EVENTS = 1000;
/** The daemon says something at least every 15 seconds. */
const SILENT = 40_000;
const SOONEST = 500;
const LATEST = 15_000;

class Live {
  machine = $state.raw<Machine>();
  services = $state.raw<Map<string, ServiceSummary>>(new Map());
  servants = $state.raw<Map<string, Served>>(new Map());
  backOffs = $state.raw<BackOff[]>([]);
  /** Newest last. */
  events = $state.raw<Event[]>([]);
  /** The daemon's clock at the last word. */
  time = $state(0);
  /** Grows with each word: for plots. */
  words = $state(0);
  /** Whether a snapshot has come. */
  known = $state(false);
  /** Why nothing comes now. */
  trouble = $state.raw<Problem>();
  /** Called when whoever looks is not let in any more. */
  refused: (problem: Problem) => void = () => {};

  #stop: AbortController | undefined;

  start(): void {
    this.stop();
    const stop = new AbortController();
    this.#stop = stop;
    void this.#listen(stop.signal);
  }

  stop(): void {
    this.#stop?.abort();
    this.#stop = undefined;
  }

  /** What was shown to one is not left for the next. */
  forget(): void {
    this.stop();
    this.machine = undefined;
    this.services = new Map();
    this.servants = new Map();
    this.backOffs = [];
    this.events = [];
    this.known = false;
    this.trouble = undefined;
  }

  async #listen(stop: AbortSignal): Promise<void> {
    let pause = SOONEST;
    while (!stop.aborted) {
      const began = Date.now();
      try {
        await this.#once(stop);
      } catch (error) {
        if (stop.aborted) return;
        if (error instanceof Problem) {
          this.trouble = error;
          if (error.status === 401 || error.status === 403) return this.refused(error);
        }
      }
      if (stop.aborted) return;
      this.trouble ??= new Problem(0, 'no answer', 'the connection to the daemon was lost', 'this page reconnects automatically');
      pause = Date.now() - began > LATEST ? SOONEST : Math.min(pause * 2, LATEST);
      await new Promise((resolve) => setTimeout(resolve, pause));
    }
  }

  async #once(stop: AbortSignal): Promise<void> {
    const silent = new AbortController();
    const either = AbortSignal.any([stop, silent.signal]);
    let timer: ReturnType<typeof setTimeout> | undefined;
    const heard = () => {
      clearTimeout(timer);
      timer = setTimeout(() => silent.abort(), SILENT);
    };
    try {
      heard();
      const answer = await fetched('/stream', { signal: either, headers: { Accept: 'text/event-stream' } });
      let name = '';
      for await (const line of lines(answer)) {
        heard();
        if (line.startsWith('event: ')) name = line.slice(7);
        else if (line.startsWith('data: ')) this.#take(name === 'snapshot', JSON.parse(line.slice(6)));
      }
    } finally {
      clearTimeout(timer);
    }
  }

  #take(whole: boolean, update: Update): void {
    this.trouble = undefined;
    if (update.machine) {
      this.machine = update.machine;
      rememberMachine(update.time, update.machine);
    } else if (whole) this.machine = undefined;
    this.services = merged(whole, this.services, update.services, update.services_gone, (one) => one.name);
    this.servants = merged(whole, this.servants, update.servants, update.servants_gone, (one) => one.servant.id);
    rememberServants(update.time, this.servants);
    this.backOffs = update.back_offs ?? this.backOffs;
    if (update.events || whole) this.events = [...(whole ? [] : this.events), ...(update.events ?? [])].slice(-EVENTS);
    this.time = update.time;
    this.words += 1;
    this.known = true;
  }
}

/** The same map where nothing has changed, so that nothing is drawn anew. */
function merged<T>(whole: boolean, then: Map<string, T>, set: T[] = [], gone: string[] = [], name: (one: T) => string): Map<string, T> {
  if (!whole && !set.length && !gone.length) return then;
  const now = new Map(whole ? [] : then);
  for (const one of gone) now.delete(one);
  for (const one of set) now.set(name(one), one);
  return now;
}

export const live = new Live();
