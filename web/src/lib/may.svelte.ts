// What whoever looks may do, as the daemon decides it: what it would refuse is not offered.
import { asked } from './api';
import type { Whoami } from './types';

/** Actions of the policy: docs/access.md. */
export type Action = 'look' | 'try' | 'logs' | 'deploy' | 'operate' | 'pair' | 'administer';

class Permissions {
  /** Whoever looks, once it is known. */
  who = $state.raw<Whoami>();
  #services = $state.raw<Map<string, string[]>>(new Map());
  /** Services that were asked for: each once. */
  readonly #asked = new Set<string>();

  async learn(): Promise<void> {
    this.who = await asked<Whoami>('/whoami');
  }

  forget(): void {
    this.who = undefined;
    this.#services = new Map();
    this.#asked.clear();
  }

  /** Whether it may be done: on the server, at a service of one's own, or at this one. Nothing may that is not known yet. */
  can(action: Action, service?: string): boolean {
    return this.#actions(service)?.includes(action) ?? false;
  }

  /** Whether it is known that it may not be done. */
  denies(action: Action, service?: string): boolean {
    return this.#actions(service)?.includes(action) === false;
  }

  #actions(service: string | undefined): string[] | undefined {
    if (service === undefined) return this.who?.may;
    const known = this.#services.get(service);
    if (!known && this.who && !this.#asked.has(service)) void this.#learnOf(service);
    return known;
  }

  async #learnOf(service: string): Promise<void> {
    this.#asked.add(service);
    try {
      const { may } = await asked<Whoami>(`/whoami?service=${encodeURIComponent(service)}`);
      // Whoever asked may not be there any more.
      if (this.#asked.has(service)) this.#services = new Map(this.#services).set(service, may);
    } catch {
      this.#asked.delete(service);
    }
  }
}

export const permissions = new Permissions();
