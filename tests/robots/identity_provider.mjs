// An identity provider (npm oidc-provider) with some people, who say who they are without being asked. `POST /knobs` with JSON
// turns what it does: `who` signs in next, `wrong` names what is wrong with its answers.
//
// usage: node identity_provider.mjs PORT ISSUER REDIRECT SECRET KEY   (NODE_PATH names where oidc-provider is)
// KEY names the key that it signs by: another name is another key. Prints `ready`.
import { createHash, createPrivateKey, createPublicKey, generateKeyPairSync } from 'node:crypto';
import { readFileSync, writeFileSync, existsSync } from 'node:fs';
import { createServer } from 'node:http';
import { join } from 'node:path';

const modules = process.env.NODE_PATH;
const { default: Provider } = await import(join(modules, 'oidc-provider/lib/index.js'));
const jose = await import(join(modules, 'jose/dist/node/esm/index.js'));
const [port, issuer, redirect, secret, keyFile] = process.argv.slice(2);

if (!existsSync(keyFile)) {
  const { privateKey } = generateKeyPairSync('rsa', { modulusLength: 2048 });
  writeFileSync(keyFile, privateKey.export({ type: 'pkcs8', format: 'pem' }), { mode: 0o600 });
}
const privateKey = createPrivateKey(readFileSync(keyFile));
const publicKey = createPublicKey(privateKey);
const stranger = generateKeyPairSync('rsa', { modulusLength: 2048 }).privateKey;
const kid = createHash('sha256').update(publicKey.export({ type: 'spki', format: 'der' })).digest('hex').slice(0, 16);
const jwk = { ...privateKey.export({ format: 'jwk' }), kid, use: 'sig', alg: 'RS256' };

const knobs = { who: 'alice', wrong: '' };
// Two people are called alice.
const people = {
  alice: { preferred_username: 'alice', groups: ['robot-admins', 'everybody'] },
  another: { preferred_username: 'alice', groups: ['students'] },
  student: { preferred_username: 'sam', groups: ['students', 'everybody'] },
  both: { preferred_username: 'dora', groups: ['students', 'builders'] },
  visitor: { preferred_username: 'vic', groups: ['visitors', '<b>bold</b>'] },
  nobody: { preferred_username: 'nell' },
};

const provider = new Provider(issuer, {
  clients: [{ client_id: 'cloudroid', client_secret: secret, redirect_uris: [redirect] }],
  jwks: { keys: [jwk] },
  claims: { openid: ['sub'], profile: ['preferred_username'], groups: ['groups'] },
  scopes: ['openid', 'profile', 'groups'],
  // In userinfo alone, as it is by default; else in the ID token.
  conformIdTokenClaims: process.env.CLAIMS_IN !== 'token',
  pkce: { required: () => true },
  features: { devInteractions: { enabled: false } },
  cookies: { keys: ['a key of a test'] },
  interactions: { url: (ctx, interaction) => `/interaction/${interaction.uid}` },
  findAccount: (ctx, id) => ({ accountId: id, claims: () => ({ sub: id, ...people[id] }) }),
  loadExistingGrant: async (ctx) => {
    const grant = new ctx.oidc.provider.Grant({ clientId: ctx.oidc.client.clientId, accountId: ctx.oidc.session.accountId });
    grant.addOIDCScope('openid profile groups');
    await grant.save();
    return grant;
  },
});

const now = () => Math.floor(Date.now() / 1000);
const sign = (claims, key, header = {}) => new jose.SignJWT(claims).setProtectedHeader({ alg: 'RS256', kid, ...header }).sign(key);
const shared = (claims, key) => new jose.SignJWT(claims).setProtectedHeader({ alg: 'HS256', kid }).sign(Buffer.from(key));
const wrongs = {
  nonce: (claims) => sign({ ...claims, nonce: 'another' }, privateKey),
  'no-nonce': ({ nonce, ...claims }) => sign(claims, privateKey),
  audience: (claims) => sign({ ...claims, aud: 'another' }, privateKey),
  'no-azp': (claims) => sign({ ...claims, aud: ['cloudroid', 'another'] }, privateKey),
  azp: (claims) => sign({ ...claims, aud: ['cloudroid', 'another'], azp: 'another' }, privateKey),
  issuer: (claims) => sign({ ...claims, iss: 'https://another.example' }, privateKey),
  expired: (claims) => sign({ ...claims, iat: now() - 7200, exp: now() - 120 }, privateKey),
  future: (claims) => sign({ ...claims, iat: now() + 3600, exp: now() + 7200 }, privateKey),
  'no-expiry': ({ exp, ...claims }) => sign(claims, privateKey),
  none: (claims) => new jose.UnsecuredJWT(claims).encode(),
  'hs256-public': (claims) => shared(claims, publicKey.export({ type: 'spki', format: 'pem' })),
  'hs256-secret': (claims) => shared(claims, secret),
  forged: (claims) => sign(claims, stranger),
  'unknown-key': (claims) => sign(claims, stranger, { kid: 'another' }),
  'access-token': (claims) => sign({ ...claims, at_hash: 'AAAAAAAAAAAAAAAAAAAAAA' }, privateKey),
  cut: async (claims) => (await sign(claims, privateKey)).slice(0, -8),
};
// Slightly off clocks, and several audiences, are right.
const rights = {
  skewed: (claims) => sign({ ...claims, iat: now() + 30, exp: now() - 30 }, privateKey),
  several: (claims) => sign({ ...claims, aud: ['cloudroid', 'another'], azp: 'cloudroid' }, privateKey),
};

provider.use(async (ctx, next) => {
  await next();
  const route = ctx.oidc?.route;
  if (route === 'token' && ctx.body?.id_token) {
    const made = wrongs[knobs.wrong] ?? rights[knobs.wrong];
    if (made) ctx.body.id_token = await made(jose.decodeJwt(ctx.body.id_token));
    if (knobs.wrong === 'no-token') delete ctx.body.id_token;
    if (knobs.wrong === 'garbage') Object.assign(ctx.body, { id_token: 'no.token.atall', access_token: 'open.sesame' });
    if (knobs.wrong === 'huge-token') ctx.body.id_token = 'x'.repeat(2 << 20);
    for (const secret of [ctx.body.id_token, ctx.body.access_token]) if (secret) console.log(`secret ${secret}`);
  }
  if (route === 'userinfo' && ctx.body) {
    if (knobs.wrong === 'userinfo') ctx.body.sub = 'another';
    if (knobs.wrong === 'list') ctx.body.groups = 'robot-admins';
  }
});

const answer = provider.callback();
const says = (response, status, body, headers = {}) => response.writeHead(status, headers).end(body);
createServer(async (request, response) => {
  const { pathname, searchParams } = new URL(request.url, issuer);
  if (pathname === '/knobs') {
    let body = '';
    for await (const part of request) body += part;
    Object.assign(knobs, JSON.parse(body));
    return says(response, 204);
  }
  if (pathname.startsWith('/interaction/')) {
    const result = knobs.wrong === 'denied'
      ? { error: 'access_denied', error_description: 'not <today>' }
      : { login: { accountId: knobs.who } };
    return provider.interactionFinished(request, response, result, { mergeWithLastSubmission: false });
  }
  if (pathname === '/.well-known/openid-configuration') {
    const json = { 'content-type': 'application/json' };
    if (knobs.wrong === 'huge') return says(response, 200, JSON.stringify({ issuer, x: 'x'.repeat(2 << 20) }), json);
    if (knobs.wrong === 'other-issuer') return says(response, 200, JSON.stringify({ issuer: 'https://another.example' }), json);
    if (knobs.wrong === 'no-json') return says(response, 200, '<h1>Welcome</h1>', { 'content-type': 'text/html' });
    if (knobs.wrong === 'silent') return;
  }
  answer(request, response);
}).listen(Number(port), '127.0.0.1', () => console.log('ready'));
