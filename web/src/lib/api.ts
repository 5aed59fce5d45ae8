// Requests to the daemon. Who asks is shown by a token, which is kept for this tab alone, or by the session's cookie.
import type { Problem as Refusal, Session } from './types';

const TOKEN = 'token';

/** A refusal, in the daemon's words (problem+json, RFC 9457). */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly title: string,
    detail: string,
    /** What to do. */
    readonly next: string,
    /** Where a name was not found: those that exist. */
    readonly exists: string[] = [],
    /** Lines of a log that explain it. */
    readonly log: string[] = [],
  ) {
    super(detail);
  }

  /** As the daemon tells it. */
  static of({ status = 0, title = '', detail, next = '', exists, log }: Told, otherwise = ''): Problem {
    return new Problem(status, title, detail || title || otherwise, next, exists, log);
  }

  /** Of what the page itself found wrong. */
  static here(detail: string, next: string): Problem {
    return new Problem(0, '', detail, next);
  }
}

/** A refusal as JSON, which may come from something before the daemon. */
type Told = Partial<Refusal>;

let csrf = '';

export const token = {
  get: () => sessionStorage.getItem(TOKEN) ?? '',
  set: (value: string) => (value ? sessionStorage.setItem(TOKEN, value) : sessionStorage.removeItem(TOKEN)),
};

const noAnswer = () => new Problem(0, 'no answer', 'the daemon does not answer', 'check that cloudroidd is running and reachable; this page reconnects automatically');

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
    throw noAnswer();
  }
  if (answer.ok) return answer;
  const said = await answer.json().catch(() => ({}));
  throw Problem.of({ title: answer.statusText, ...said, status: answer.status }, `the daemon answered with ${answer.status}`);
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

/** How often lines of an answer are looked for: each look copies what has come so far. */
const LOOKS = 200;

/** Sends a body and gives lines of the answer as they come; `gone` is told how much of the body was sent, which `fetch` tells nobody, and `placed` where the daemon keeps what was begun. */
export async function* exchanged(
  path: string,
  body: Blob | undefined,
  signal: AbortSignal,
  gone: (done: number, total: number) => void,
  placed: (location: string) => void = () => {},
): AsyncGenerator<string> {
  const request = new XMLHttpRequest();
  request.open('POST', `/api/v1${path}`);
  if (token.get()) request.setRequestHeader('Authorization', `Bearer ${token.get()}`);
  else if (csrf) request.setRequestHeader('X-CSRF-Token', csrf);
  let wake = () => {};
  let over = false;
  let failed: Problem | undefined;
  request.upload.onprogress = ({ loaded, total }) => gone(loaded, total);
  request.onprogress = () => wake();
  request.onreadystatechange = () => { if (request.readyState === XMLHttpRequest.HEADERS_RECEIVED) placed(request.getResponseHeader('Location') ?? ''); };
  request.onerror = () => { failed = noAnswer(); };
  request.onloadend = () => {
    over = true;
    wake();
  };
  const stop = () => request.abort();
  signal.addEventListener('abort', stop);
  try {
    signal.throwIfAborted();
    request.send(body);
    let at = 0;
    for (;;) {
      const ended = over;
      signal.throwIfAborted();
      if (failed) throw failed;
      const refused = request.readyState >= 2 && (request.status < 200 || request.status > 299);
      if (refused && ended) throw Problem.of({ title: request.statusText, ...told(request.responseText), status: request.status }, `the daemon answered with ${request.status}`);
      const text = refused ? '' : request.responseText;
      for (let end = text.indexOf('\n', at); end >= 0; end = text.indexOf('\n', at)) {
        yield text.slice(at, end);
        at = end + 1;
      }
      if (ended) {
        if (at < text.length) yield text.slice(at);
        return;
      }
      if (over) continue;
      await new Promise<void>((resolve) => { wake = resolve; });
      if (!over) await new Promise((resolve) => setTimeout(resolve, LOOKS));
    }
  } finally {
    signal.removeEventListener('abort', stop);
    if (!over) request.abort();
  }
}

function told(text: string): Told {
  try {
    return JSON.parse(text);
  } catch {
    return {};
  }
}
