// Who is unhappy, and why: what the overview and a robot's page show first.
import { promise } from './history';
import type { Event, Served } from './types';
import { number, time } from './words';

export interface Complaint { level: 'bad' | 'busy'; words: string }

/** Whether some of its requests were answered late, or not at all. */
export function isLate(served: Served): boolean {
  const { max } = promise(served);
  return served.links.some((link) => link.late > 0) || (max != null && (served.servant.response?.p95_ms ?? 0) > max);
}

/** What is wrong with a servant as its robot sees it; the worst first. */
export function complaints(served: Served): Complaint[] {
  const { servant, links } = served;
  const [bad, busy]: [string[], string[]] = [[], []];
  if (servant.phase === 'failed') bad.push(`failed${servant.reason ? `: ${servant.reason}` : ''}`);
  if (servant.hung.length) bad.push(`not responding: ${servant.hung.join(', ')}`);
  if (servant.down.length) bad.push(`down: ${servant.down.map((one) => one.node).join(', ')}`);
  for (const { refused } of servant.lifecycle) if (refused) bad.push(refused);
  for (const { node, up, late, requests, satisfaction, threshold } of links) {
    if (!up) bad.push(`the link of ${node} is down`);
    if (late > 0) busy.push(`${late} of the last ${requests} requests of ${node} were late`);
    if (satisfaction != null && threshold != null && satisfaction < threshold) busy.push(`Q of ${node} is ${number(satisfaction)}, below its threshold of ${number(threshold)}`);
  }
  const { max } = promise(served);
  const p95 = servant.response?.p95_ms;
  if (max != null && p95 != null && p95 > max) busy.push(`p95 of the response time is ${time(p95)}, above T_max (${time(max)})`);
  return [...bad.map((words): Complaint => ({ level: 'bad', words })), ...busy.map((words): Complaint => ({ level: 'busy', words }))];
}

/** The colour of the worst of them. */
export const worst = (all: Complaint[]) => (all.some((one) => one.level === 'bad') ? 'bad' : all.length ? 'busy' : 'good');

// Whose push has failed, as the daemon writes it: a push that nobody has named bears the name of what was sent.
const pushed = ({ service, message }: Event) => service ?? /^the push of (\S+)/.exec(message)?.[1] ?? '';

/** The last event about a push. */
export const lastPush = (events: Event[], service?: string) =>
  events.findLast((event) => (event.kind === 'published' || event.kind === 'push-failed') && (service === undefined || pushed(event) === service));

/** An event of a list, and older ones that it stands for. */
export interface Told { event: Event; older: Event[] }

/** Events as they are listed, in the same order: of the failed pushes of one service the first alone stands for all. */
export function condensed(events: Event[]): Told[] {
  const told: Told[] = [];
  const failed = new Map<string, Told>();
  for (const event of events) {
    const whose = pushed(event);
    const known = event.kind === 'push-failed' ? failed.get(whose) : undefined;
    if (known) {
      known.older.push(event);
      continue;
    }
    const one: Told = { event, older: [] };
    told.push(one);
    if (event.kind === 'push-failed') failed.set(whose, one);
  }
  return told;
}
