// Requests to the daemon. Who asks is shown by a token, which is kept for this tab alone, or by the session's cookie.
import type { Session } from './types';

const TOKEN = 'token';

/** A refusal, in the daemon's words (problem+json, RFC 9457). */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly title: string,
    detail: string,
    /** What to do. */
    readonly next: string,
  ) {
    super(detail);
  }
}

let csrf = '';

export const token = {
  get: () => sessionStorage.getItem(TOKEN) ?? '',
  set: (value: string) => (value ? sessionStorage.setItem(TOKEN, value) : sessionStorage.removeItem(TOKEN)),
};

/** Asks, and gives the answer if it is none of refusal. */
export async function fetched(path: string, options: RequestInit = {}, base = '/api/v1'): Promise<Response> {
  const headers = new Headers(options.headers);
  if (token.get()) headers.set('Authorization', `Bearer ${token.get()}`);
  else if (csrf) headers.set('X-CSRF-Token', csrf);
  let answer: Response;
  try {
    answer = await fetch(`${base}${path}`, { ...options, headers, cache: 'no-store' });
  } catch (error) {
    if (options.signal?.aborted) throw error;
    throw new Problem(0, 'no answer', 'the daemon does not answer', 'look whether cloudroidd runs and can be reached; this page goes on by itself when it does');
  }
  if (answer.ok) return answer;
  const said = await answer.json().catch(() => ({}));
  throw new Problem(answer.status, said.title ?? answer.statusText, said.detail ?? answer.statusText, said.next ?? '');
}

export async function asked<T>(path: string, options?: RequestInit): Promise<T> {
  const answer = await fetched(path, options);
  return answer.status === 204 ? (undefined as T) : answer.json();
}

export const sent = <T>(method: string, path: string, body?: unknown): Promise<T> =>
  asked<T>(path, {
    method,
    ...(body === undefined ? {} : { body: JSON.stringify(body), headers: { 'Content-Type': 'application/json' } }),
  });

/** Who is signed in; remembers what requests that change something need. */
export async function session(): Promise<Session> {
  const known = await asked<Session>('/session');
  csrf = known.csrf ?? '';
  return known;
}

export async function signIn(name: string, password: string): Promise<void> {
  token.set('');
  const known = await sent<Session>('POST', '/session', { name, password });
  csrf = known.csrf ?? '';
}

/** Has the browser keep an answer as a file: a link alone would show no token. */
export async function kept(path: string, name: string): Promise<void> {
  const url = URL.createObjectURL(await (await fetched(path, {}, '')).blob());
  Object.assign(document.createElement('a'), { href: url, download: name }).click();
  URL.revokeObjectURL(url);
}

/** Lines of an answer, as they come. */
export async function* lines(answer: Response): AsyncGenerator<string> {
  if (!answer.body) return;
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = '';
  for (;;) {
    const { value, done } = await reader.read();
    if (done) break;
    const parts = (rest + value).split('\n');
    rest = parts.pop() ?? '';
    yield* parts;
  }
  if (rest) yield rest;
}
