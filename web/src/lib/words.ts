// Figures in words.
import type { Limits, PushCount } from './types';

const UNITS = ['B', 'kB', 'MB', 'GB', 'TB'];

/** Bytes, in units of 1024 as everywhere in Cloudroid. */
export function size(bytes: number): string {
  let unit = 0;
  let rest = bytes;
  while (rest >= 1024 && unit < UNITS.length - 1) {
    rest /= 1024;
    unit += 1;
  }
  return `${rest >= 10 || unit === 0 ? Math.round(rest) : rest.toFixed(1)}\u00a0${UNITS[unit]}`;
}

/** A span of milliseconds. */
export function span(milliseconds: number): string {
  const seconds = Math.max(0, Math.floor(milliseconds / 1000));
  if (seconds < 120) return `${seconds} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.floor(seconds / 3600)} h` : `${Math.floor(seconds / 86400)} d`;
}

/** A response time. */
export function time(milliseconds: number | undefined): string {
  if (milliseconds == null) return '–';
  if (milliseconds === 0) return '0\u00a0ms';
  if (milliseconds >= 1000) return `${(milliseconds / 1000).toFixed(2)}\u00a0s`;
  return `${milliseconds >= 10 ? Math.round(milliseconds) : milliseconds.toFixed(1)}\u00a0ms`;
}

/** Of small ones two digits, of others two behind the point. */
export const number = (value: number) => (Math.abs(value) < 0.1 ? String(+(Math.abs(value) < 0.0005 ? 0 : value).toPrecision(2)) : String(+value.toFixed(2)));
export const percent = (share: number) => `${Math.round(share * 100)}\u00a0%`;

export function count(what: number, word: string): string {
  return `${what} ${word}${what === 1 ? '' : 's'}`;
}

/** How far something is. */
export function progress({ unit, done, total }: PushCount): string {
  const amount = (value: number) => (unit === 'bytes' ? size(value) : String(value));
  return `${amount(done)}${total ? ` of ${amount(total)}` : ''}${unit === 'bytes' ? '' : ` ${unit}`}`;
}

export function limits(of: Limits | undefined): string {
  if (!of) return 'none';
  const parts = [
    of.cpus != null && count(of.cpus, 'core'),
    of.memory != null && size(of.memory),
    of.pids != null && `${of.pids} processes`,
    of.cpuset && `on cores ${of.cpuset}`,
  ];
  return parts.filter(Boolean).join(', ') || 'none';
}

const CLOCK = new Intl.DateTimeFormat('en-GB', { hour: '2-digit', minute: '2-digit', second: '2-digit' });
const DATE = new Intl.DateTimeFormat('en-GB', { dateStyle: 'medium', timeStyle: 'medium' });
const MINUTE = new Intl.DateTimeFormat('en-GB', { hour: '2-digit', minute: '2-digit' });
const DAY = new Intl.DateTimeFormat('en-GB', { day: 'numeric', month: 'short' });
const YEAR = new Intl.DateTimeFormat('en-GB', { day: 'numeric', month: 'short', year: 'numeric' });

// The browser's day, in milliseconds since 1970: looked up again once it is over.
let [morning, midnight] = [0, 0];

function today(at: number): boolean {
  const now = Date.now();
  if (now < morning || now >= midnight) {
    const day = new Date(now);
    morning = day.setHours(0, 0, 0, 0);
    midnight = day.setDate(day.getDate() + 1);
  }
  return at >= morning && at < midnight;
}

const day = (at: number) => (new Date(at).getFullYear() === new Date().getFullYear() ? DAY : YEAR).format(at);

/** A time in full. All times are local. */
export const date = (at: number) => DATE.format(at);
/** A time, with the date where it is not today. */
export const moment = (at: number) => (today(at) ? CLOCK.format(at) : `${day(at)}, ${CLOCK.format(at)}`);
/** The same for an axis, shorter. */
export const tick = (at: number) => (today(at) ? CLOCK.format(at) : `${day(at)} ${MINUTE.format(at)}`);
