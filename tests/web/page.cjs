// The portal's page in Chromium, step by step as a person goes through it.
//
// usage: node page.cjs STEP URL PICTURES TOKEN PACKAGE   (NODE_PATH names where puppeteer-core and axe-core are; PACKAGE is adder_py;
// RECORDING, for calibrator, a recording for teller_py)
//
// Every page that is come by is judged by axe-core in both themes and at a phone's width, and a picture of each is kept. What
// breaks the content security policy, or fails in the page, fails here.
'use strict';
const assert = require('node:assert');
const { execFileSync } = require('node:child_process');
const { randomBytes } = require('node:crypto');
const { appendFileSync, cpSync, mkdirSync, readFileSync, rmSync, writeFileSync } = require('node:fs');
const { join, resolve } = require('node:path');
const jsQR = require('jsqr');
const puppeteer = require('puppeteer-core');

// Milliseconds, longer on a busy machine.
const PATIENCE = Number(process.env.STORY_PATIENCE ?? 60) * 1000;
const AXE = readFileSync(require.resolve('axe-core/axe.min.js'), 'utf8');
const LAPTOP = { width: 1280, height: 900 };
const PHONE = { width: 390, height: 844 };

const [step, url, pictures, token, sources] = process.argv.slice(2);

// What a person does and sees.
class Visitor {
  constructor(page) {
    this.page = page;
    this.wrong = [];
    // The browser writes each into its console: a visit that does only what one may has none.
    this.refused = [];
    page.on('response', (answer) => { if ([403, 404].includes(answer.status())) this.refused.push(`${answer.status()} ${answer.url()}`); });
    page.setDefaultTimeout(PATIENCE);
    page.on('pageerror', (error) => this.wrong.push(String(error)));
    page.on('console', (message) => {
      // A refused request is written there by the browser itself.
      if (message.type() === 'error' && !message.text().startsWith('Failed to load resource')) this.wrong.push(message.text());
    });
  }

  sees(text) {
    return this.page.waitForFunction((wanted) => document.body.innerText.includes(wanted), {}, text)
      .catch(async () => assert.fail(`${JSON.stringify(text)} is not to be seen in:\n${await this.page.evaluate(() => document.body.innerText)}`));
  }

  seesNot(text) {
    return this.page.waitForFunction((wanted) => !document.body.innerText.includes(wanted), {}, text);
  }

  // By the name that a screen reader says.
  clicks(name, role = 'button') {
    return this.page.locator(`::-p-aria([name="${name}"][role="${role}"])`).click();
  }

  async types(label, text) {
    const box = await this.page.waitForSelector(`::-p-aria([name="${label}"])`);
    await box.click({ count: 3 });
    await box.type(text);
  }

  // Once the daemon has said what one may do at this service.
  async opensKnowing(hash, service) {
    const told = this.page.waitForResponse((answer) => answer.url().endsWith(`/whoami?service=${service}`));
    await this.opens(hash);
    await told;
  }

  // What one may not do is not offered.
  async offersNone(words) {
    const offered = await this.page.$$eval('main button, main a', (all) => all.filter((one) => one.checkVisibility()).map((one) => one.innerText.trim()));
    assert.deepStrictEqual(offered.filter((one) => words.test(one)), []);
  }

  pages() {
    return this.page.$$eval('nav a', (all) => all.map((one) => one.innerText.trim()));
  }

  // Titles of the plots that are to be seen.
  plots() {
    return this.page.$$eval('figure:not([hidden]) h3', (all) => all.map((one) => one.innerText.trim()));
  }

  // In a list, once it is there.
  async chooses(label, value) {
    const list = await this.page.waitForSelector(`::-p-aria([name="${label}"][role="combobox"])`);
    await this.page.waitForFunction((select, wanted) => [...select.options].some((option) => option.value === wanted), {}, list, value);
    await list.select(value);
  }

  // By the tabulator alone, from where the keyboard is; by the name that a screen reader says.
  async tabsTo(name) {
    const there = () => this.page.evaluate((wanted) => {
      const { activeElement: at } = document;
      const label = at.labels?.[0]?.innerText ?? '';
      const named = document.getElementById(at.getAttribute('aria-labelledby'))?.innerText;
      return [at.getAttribute('aria-label'), named, at.innerText, label].some((text) => text?.trim().startsWith(wanted));
    }, name);
    for (let stops = 0; stops < 200; stops += 1) {
      if (await there()) return;
      await this.page.keyboard.press('Tab');
    }
    assert.fail(`the tabulator does not come to ${name}`);
  }

  // A topic inside a servant, and no other; none where none is named.
  async looksAt(topic) {
    await this.page.$$eval('article button', (all) => { for (const one of all) if (one.innerText.startsWith('Close')) one.click(); });
    if (topic) await this.looksBeside(topic);
  }

  // A topic beside those that are open.
  looksBeside(topic) {
    return this.clicks(topic);
  }

  // The form by which messages are published on a topic that is open.
  writesTo(topic) {
    return this.clicks(`Publish… on ${topic}`);
  }

  opens(hash) {
    return this.page.evaluate((to) => { location.hash = to; }, hash);
  }

  // Over a number or a text of a form, by the label of its field.
  async fills(form, label, text) {
    const box = await this.page.waitForSelector(`form[aria-label="${form}"] ::-p-aria([name="${label}"])`);
    await box.click({ count: 3 });
    await box.type(text);
  }

  // Once the plot with this title has pixels in the colour of its first line.
  drawn(title) {
    return this.page.waitForFunction((title) => {
      const figure = [...document.querySelectorAll('figure')].find((one) => one.innerText.startsWith(title));
      const canvas = figure?.querySelector('canvas');
      if (!canvas?.width) return false;
      const probe = figure.appendChild(document.createElement('span'));
      probe.style.color = 'var(--series-1)';
      const wanted = getComputedStyle(probe).color.match(/\d+/g).map(Number);
      probe.remove();
      const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
      let found = 0;
      for (let at = 0; at < data.length; at += 4) if (data[at + 3] > 100 && wanted.every((one, part) => Math.abs(one - data[at + part]) < 6)) found += 1;
      return found > 10;
    }, {}, title);
  }

  // Files or a folder, from beside the browser.
  async drops(selector, files) {
    const place = await this.page.waitForSelector(selector);
    await place.scrollIntoView();
    const { x, y, width, height } = await place.boundingBox();
    const session = await this.page.createCDPSession();
    for (const type of ['dragEnter', 'dragOver', 'drop']) {
      await session.send('Input.dispatchDragEvent', { type, x: x + width / 2, y: y + height / 2, data: { items: [], files, dragOperationsMask: 1 } });
    }
    await session.detach();
  }

  // Whatever is sent takes its time, so many bytes a second; all that the line carries where nothing is said. Until what is given back is called.
  async slowly(bytes) {
    const session = await this.page.createCDPSession();
    await session.send('Network.enable');
    await session.send('Network.emulateNetworkConditions', { offline: false, latency: 0, downloadThroughput: -1, uploadThroughput: bytes });
    return () => session.detach();
  }

  // A refusal, in words and with what to do.
  async isRefused(words) {
    await this.sees(words);
    await this.saysWhatToDo(words);
  }

  // Every trouble that is to be seen has words and a next step.
  async saysWhatToDo(where) {
    const mute = await this.page.$$eval('.trouble, [role=alert]', (all) => all.filter((one) => one.checkVisibility() && one.innerText.trim())
      .filter((one) => !one.querySelector('strong')?.innerText.trim() || !one.querySelector('.next')?.innerText.replace('What to do:', '').trim())
      .map((one) => one.innerText));
    assert.deepStrictEqual(mute, [], `${where}: words without a next step`);
  }

  // Both themes, both widths, judged by axe-core; a picture of each.
  async judges(name) {
    await this.saysWhatToDo(name);
    for (const theme of ['light', 'dark']) {
      await this.page.emulateMediaFeatures([{ name: 'prefers-color-scheme', value: theme }, { name: 'prefers-reduced-motion', value: 'reduce' }]);
      for (const [width, viewport] of Object.entries({ laptop: LAPTOP, phone: PHONE })) {
        await this.page.setViewport(viewport);
        // Two frames: what hangs on theme and width is drawn.
        await this.page.evaluate(() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn))));
        await this.page.screenshot({ path: `${pictures}/${name}-${theme}-${width}.png`, fullPage: true });
        await this.page.evaluate(AXE);
        const { violations } = await this.page.evaluate(() => axe.run(document, { resultTypes: ['violations'] }));
        const told = violations.map(({ id, help, nodes }) => `${id}: ${help}: ${nodes.map((node) => `${node.target} ${node.failureSummary}`).join('; ')}`);
        assert.deepStrictEqual(told, [], `${name}, ${theme}, ${width}`);
        const beyond = await this.page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
        assert(beyond <= 0, `${name} is ${beyond} pixels wider than a ${width}`);
      }
    }
    await this.page.setViewport(LAPTOP);
  }

  // What another client asks the daemon for at the same time, with this one's token: this page does not know of it.
  elsewhere(method, path, body) {
    return this.page.evaluate(async (method, path, body) => {
      const headers = { Authorization: `Bearer ${sessionStorage.getItem('token')}`, 'Content-Type': 'application/json' };
      const answer = await fetch(`/api/v1${path}`, { method, headers, ...(body ? { body: JSON.stringify(body) } : {}) });
      if (!answer.ok) throw new Error(`${method} ${path}: ${answer.status} ${await answer.text()}`);
      return answer.json();
    }, method, path, body);
  }

  async signsIn() {
    await this.types('Token', token);
    await this.clicks('Sign in with a token');
    await this.page.waitForSelector('nav');
  }
}

const STEPS = {
  // Before anything was pushed.
  async empty(visitor) {
    await visitor.sees('With an account');
    await visitor.judges('sign-in');
    await visitor.types('Name', 'ada');
    await visitor.types('Password', 'wrong and long enough');
    await visitor.clicks('Sign in');
    await visitor.sees('name or password is wrong');
    await visitor.types('Token', 'nobody knows this one');
    await visitor.clicks('Sign in with a token');
    await visitor.sees('token is not known');
    await visitor.signsIn();
    await visitor.sees('No service is published yet');
    await visitor.judges('overview-empty');
    await visitor.clicks('Services', 'link');
    await visitor.sees('cloudroidctl push --apt');
    await visitor.clicks('Robots and servants', 'link');
    await visitor.sees('No robots connected');
    await visitor.judges('servants-empty');
    await visitor.opens('#/nowhere');
    await visitor.sees('Page not found');
    await visitor.judges('not-found');
  },

  // Two revisions of adder_py: the folder, and an archive of it.
  async deployer(visitor) {
    await visitor.signsIn();
    await visitor.clicks('Deploy', 'link');
    // Three questions; all else is folded.
    for (const question of ['1. Package', '2. Nodes or launch file', '3. Name', 'ROS 2 (ament)']) await visitor.sees(question);
    assert.strictEqual((await visitor.page.$$('form details[open]')).length, 0);
    assert.strictEqual((await visitor.page.$$eval('form input:not([type]), form textarea', (all) => all.filter((one) => one.checkVisibility()).length)), 3);
    await visitor.judges('deploy-empty');
    // What there is to build upon is asked for when it is unfolded.
    await visitor.page.locator('summary ::-p-text(Bases and underlays)').click();
    for (const words of ['bookworm-ros1', 'debian bookworm']) await visitor.sees(words);
    await visitor.judges('deploy-bases');
    await visitor.clicks('Push');
    await visitor.sees('no package is chosen');
    const folder = await visitor.page.waitForSelector('input[webkitdirectory]');
    const file = await visitor.page.waitForSelector('input[type=file]:not([webkitdirectory])');
    await file.uploadFile(join(sources, 'package.xml'));
    await visitor.sees('package.xml is not a tar archive');
    await folder.uploadFile(sources);
    await visitor.sees('Chosen: the folder adder_py');
    await visitor.types('Programs with their arguments, one per line', 'nobody.py');
    await visitor.clicks('Push');
    await visitor.sees('nobody.py');
    await visitor.page.waitForSelector('.trouble');
    await visitor.judges('deploy-failed');
    await visitor.types('Programs with their arguments, one per line', 'adder.py');
    // An archive is dropped, and the push of it cancelled while it is sent.
    const [published, cancelled] = [() => visitor.elsewhere('GET', '/services'), 'Cancelled: nothing was published.'];
    const large = join(pictures, 'large');
    cpSync(sources, join(large, 'adder_py'), { recursive: true });
    writeFileSync(join(large, 'adder_py', 'noise'), randomBytes(4 << 20));
    execFileSync('tar', ['czf', `${large}.tar.gz`, '-C', large, 'adder_py']);
    await visitor.drops('.drop', [resolve(`${large}.tar.gz`)]);
    await visitor.sees('Chosen: large.tar.gz, 4.0');
    const fast = await visitor.slowly(400_000);
    await visitor.clicks('Push');
    await visitor.page.waitForFunction(() => /\b[1-9]\d?\s%: [\d.]+\s[kM]B of 4\.0\sMB/.test(document.body.innerText));
    await visitor.judges('deploy-sending');
    await visitor.clicks('Cancel');
    await visitor.sees(cancelled);
    await visitor.judges('deploy-cancelled');
    await fast();
    rmSync(large, { recursive: true });
    rmSync(`${large}.tar.gz`);
    // The folder is dropped, and the push of it cancelled while it is looked at. What it ignores is decided at once, however many
    // ways to match a pattern has.
    const ignoring = join(pictures, 'ignoring');
    cpSync(sources, join(ignoring, 'adder_py'), { recursive: true });
    writeFileSync(join(ignoring, 'adder_py', '.cloudroidignore'), `${'**/'.repeat(30)}${'*a'.repeat(30)}*b\n`);
    writeFileSync(join(ignoring, 'adder_py', 'a'.repeat(200)), '');
    await visitor.drops('.drop', [resolve(ignoring, 'adder_py')]);
    await visitor.sees('Chosen: the folder adder_py');
    await visitor.clicks('Push');
    await visitor.sees('starting it once');
    await visitor.clicks('Cancel');
    await visitor.sees(cancelled);
    assert.strictEqual(await visitor.page.$('.trouble'), null);
    assert.deepStrictEqual(await published(), []);
    await visitor.drops('.drop', [resolve(sources)]);
    await visitor.sees('Chosen: the folder adder_py');
    await visitor.tabsTo('Push');
    await visitor.page.keyboard.press('Enter');
    await visitor.sees('Published: adder_py, revision 1');
    rmSync(ignoring, { recursive: true });
    await visitor.sees('Interface found');
    await visitor.page.waitForFunction(() => document.querySelector('section[aria-labelledby="push"]').innerText.includes('adder_py/AddTwo'));
    // The earlier ones are listed, and what they printed can be read.
    await visitor.sees('of push 2');
    await visitor.judges('deploy');
    const answered = visitor.page.waitForResponse((answer) => answer.url().endsWith('/stubs/adder_py.tar.gz'));
    await visitor.clicks('Download the stub');
    assert.strictEqual((await answered).status(), 200);
    // The same package makes no revision, a changed one does.
    await visitor.clicks('Push');
    await visitor.sees('Unchanged: adder_py, revision 1 serves');
    const [archive, changed] = [join(pictures, 'adder_py.tar.gz'), join(pictures, 'changed')];
    cpSync(sources, join(changed, 'adder_py'), { recursive: true });
    appendFileSync(join(changed, 'adder_py', 'package.xml'), '<!-- Revision 2. -->\n');
    execFileSync('tar', ['czf', archive, '-C', changed, 'adder_py']);
    rmSync(changed, { recursive: true });
    await file.uploadFile(archive);
    await visitor.sees('Chosen: adder_py.tar.gz');
    await visitor.clicks('Push');
    await visitor.sees('Published: adder_py, revision 2');
  },

  // A robot is served by the second revision of adder_py.
  async operator(visitor) {
    await visitor.signsIn();
    await visitor.sees('Cores reserved');
    await visitor.sees('is ready for rover');
    // In one sentence.
    await visitor.sees('1 service, 1 robot served,');
    await visitor.page.waitForFunction(() => /last push \d+ (s|min) ago/.test(document.querySelector('.status').innerText));
    await visitor.judges('overview');
    await visitor.clicks('Robot rover', 'link');
    await visitor.sees('served by 1 instance');
    await visitor.sees('Not paired');
    await visitor.drawn('adder_py');
    await visitor.judges('robot');

    await visitor.clicks('Services', 'link');
    await visitor.sees('adder_py');
    await visitor.judges('services');
    await visitor.clicks('adder_py', 'link');
    await visitor.sees('/add_two');
    await visitor.sees('Use revision 1');
    await visitor.judges('service');

    await visitor.clicks('Robots and servants', 'link');
    await visitor.sees('1 of 1');
    await visitor.judges('servants');
    await visitor.types('Find by robot, service or class', 'nobody');
    await visitor.sees('No matches');
    await visitor.types('Find by robot, service or class', 'rover adder');
    await visitor.sees('1 of 1');
    await visitor.chooses('Show', 'services');
    await visitor.sees('No matches');
    await visitor.chooses('Show', 'all');
    await visitor.clicks('Memory');
    assert.strictEqual(await visitor.page.$eval('th[aria-sort=descending]', (head) => head.innerText.trim().split(' ')[0]), 'Memory');

    await visitor.clicks('rover', 'link');
    await visitor.sees('Limits in force (read from the kernel)');
    // Its response times are told, and drawn; what it has stated beside them.
    await visitor.page.waitForFunction(() => /p50\s*[\d.]+\s*ms/.test(document.body.innerText));
    await visitor.page.waitForFunction(() => /T_max\s*200\s*ms/.test(document.body.innerText));
    await visitor.drawn('Response time (RRT)');
    // Without a link there are no parts of the response time, and no satisfaction.
    const there = 'Response time (RRT), Cores, CPU throttled, Memory, Messages dropped';
    await visitor.page.waitForFunction((wanted) => [...document.querySelectorAll('figure:not([hidden]) h3')].map((one) => one.innerText.trim()).join(', ') === wanted, {}, there);
    // The cursor tells the time and the figures there, in all plots.
    const plot = await visitor.page.waitForSelector('[aria-label^="Plot: Cores"] .u-over');
    await plot.scrollIntoView();
    const { x, y, width, height } = await plot.boundingBox();
    await visitor.page.mouse.move(x + width * 0.9, y + height / 2);
    const times = () => [...document.querySelectorAll('figure:not([hidden]) figcaption')].filter((one) => /^\d\d:\d\d:\d\d/.test(one.innerText)).length;
    await visitor.page.waitForFunction(`(${times})() === 5`, {});
    // What is dragged over is looked at more closely.
    await visitor.page.mouse.down();
    await visitor.page.mouse.move(x + width * 0.5, y + height / 2, { steps: 5 });
    await visitor.page.mouse.up();
    await visitor.sees('Show the whole period');
    await visitor.judges('servant-zoomed');
    await visitor.clicks('Show the whole period of Cores');
    await visitor.seesNot('Show the whole period');
    // The same by the keyboard, in words.
    await visitor.page.focus('[aria-label^="Plot: Memory"]');
    await visitor.page.keyboard.press('ArrowLeft');
    await visitor.page.waitForFunction(() => [...document.querySelectorAll('figcaption [role=status]')].some((one) => /^\d\d:\d\d:\d\d: used \d/.test(one.innerText)));
    await visitor.page.keyboard.press('+');
    await visitor.sees('Show the whole period');
    await visitor.page.keyboard.press('Escape');
    await visitor.seesNot('Show the whole period');
    // What the daemon has recorded, in place of what this page has seen.
    for (const of of ['the last day', 'the last hour']) await visitor.clicks(of, 'radio');
    const recorded = () => [...document.querySelectorAll('figure')].some((one) => one.innerText.startsWith('Memory') && /\d/.test(one.querySelector('b').innerText));
    await visitor.page.waitForFunction(recorded);
    await visitor.clicks('Explain');
    await visitor.page.waitForFunction(() => document.querySelector('[aria-labelledby=why] [role=status]').innerText.trim() !== '');
    // Sliders stand where the kernel says, whoever has changed it: here to what no step of theirs is.
    const servant = `/servants/${(await visitor.page.evaluate(() => location.hash)).split('/')[2]}`;
    const enforced = async () => (await visitor.elsewhere('GET', servant)).enforced;
    const slider = (name, words) => visitor.page.waitForFunction((name, words) => [...document.querySelectorAll('input[type=range]')]
      .some((range) => range.labels[0].innerText.startsWith(name) && range.ariaValueText === words), {}, name, words);
    await visitor.elsewhere('PATCH', servant, { memory: 300_000_000 });
    await slider('Memory', '286\u00a0MB');
    const before = await enforced();
    // By the keyboard alone: least of all, and one step more. What was not moved stays as it is.
    await visitor.page.focus('h1');
    await visitor.tabsTo('Cores');
    await visitor.page.keyboard.press('Home');
    await visitor.page.keyboard.press('ArrowRight');
    await visitor.sees('Cores: 0.1, in force');
    await visitor.tabsTo('Set limits');
    await visitor.page.keyboard.press('Enter');
    await visitor.sees('In force (read from the kernel): 0.1 cores');
    await visitor.seesNot('Cores: 0.1, in force');
    // But for the weight, which the controller moves by what the machine has to do.
    assert.deepStrictEqual({ ...await enforced(), cpu_weight: 0 }, { ...before, cpus: 0.1, cpu_weight: 0 });
    await visitor.tabsTo('Memory');
    await visitor.page.keyboard.press('ArrowLeft');
    await visitor.tabsTo('Set limits');
    await visitor.page.keyboard.press('Enter');
    await visitor.sees('In force (read from the kernel): 0.1 cores, 272\u00a0MB');
    const { cpus, memory } = await enforced();
    assert.deepStrictEqual({ cpus, memory }, { cpus: 0.1, memory: 272 << 20 });
    await visitor.elsewhere('PATCH', servant, { cpus: 0.5 });
    await slider('Cores', '0.5');
    await visitor.seesNot('In force (read from the kernel): 0.1 cores');
    await slider('Memory', '272\u00a0MB');
    // What was moved is let go.
    await visitor.page.focus('h1');
    await visitor.tabsTo('Cores');
    await visitor.page.keyboard.press('ArrowRight');
    await visitor.sees('Cores: 0.55, in force 0.5');
    await visitor.judges('servant');
    await visitor.clicks('Reset');
    await slider('Cores', '0.5');

    await visitor.clicks('Log', 'link');
    await visitor.sees('the sum is negative: -40');
    // rospy prints warnings in yellow.
    await visitor.page.waitForSelector('.log .ansi-yellow');
    await visitor.judges('log');
    await visitor.types('Find', 'negative: -41');
    await visitor.seesNot('negative: -40');
    await visitor.sees('negative: -41');

    await visitor.clicks('Events', 'link');
    await visitor.sees('is ready for rover');
    // Failed pushes of a package are one entry.
    await visitor.sees('earlier failed push');
    assert.strictEqual(await visitor.page.$$eval('main li', (all) => all.filter((one) => one.innerText.includes('the push of adder_py')).length), 1);
    await visitor.judges('events');
    await visitor.types('Find', 'no such words');
    await visitor.sees('No matches');

    // Back to the revision before.
    await visitor.opens('#/services/adder_py');
    await visitor.sees('Use revision 1…');
    // By the keyboard alone, and the question is put to it.
    await visitor.page.focus('h1');
    await visitor.tabsTo('Use revision 1…');
    await visitor.page.keyboard.press('Enter');
    await visitor.sees('Make revision 1 the current one?');
    await visitor.judges('confirm');
    await visitor.tabsTo('Use it');
    await visitor.page.keyboard.press('Enter');
    await visitor.sees('Use revision 2…');
    // They were pushed in different ways, and nothing else: the newest beside the one before.
    const differing = await visitor.page.waitForSelector('section[aria-labelledby="differences"] tbody tr');
    assert.match(await differing.evaluate((row) => row.innerText), /push\s+source\s/);
    await visitor.chooses('with revision', '1');
    await visitor.sees('No differences');
    await visitor.judges('service-differences');

    // By the keyboard alone: the first stop of the tabulator skips what is on every page.
    await visitor.page.reload();
    // The heading, to which it leads, comes after the navigation.
    await visitor.page.waitForSelector('main h1');
    await visitor.page.keyboard.press('Tab');
    await visitor.page.keyboard.press('Enter');
    assert.strictEqual(await visitor.page.evaluate(() => document.activeElement.tagName), 'H1');
  },

  // Through TLS: prints the line, which is good once, for whoever started this to pair a robot with.
  async pairing(visitor) {
    await visitor.signsIn();
    await visitor.clicks('Access', 'link');
    await visitor.types("Robot's name", 'rover');
    await visitor.clicks('Pair');
    await visitor.sees("cloudroid-stub pair '");
    await visitor.judges('pairing');
    const [, line] = /cloudroid-stub pair '(.*)'/.exec(await visitor.page.evaluate(() => document.body.innerText));
    // What a camera reads is the same.
    const { size, path } = await visitor.page.$eval('svg[role=img]', (svg) => ({ size: svg.viewBox.baseVal.width, path: svg.querySelector('path').getAttribute('d') }));
    const scale = 4;
    const picture = new Uint8ClampedArray((size * scale) ** 2 * 4).fill(255);
    for (const [, x, y] of path.matchAll(/M(\d+) (\d+)h/g)) {
      for (let row = 0; row < scale; row += 1) {
        for (let column = 0; column < scale; column += 1) picture.fill(0, ((y * scale + row) * size * scale + x * scale + column) * 4, ((y * scale + row) * size * scale + x * scale + column) * 4 + 3);
      }
    }
    assert.strictEqual(jsQR(picture, size * scale, size * scale)?.data, line);
    console.log(line);
    await visitor.clicks('Revoke the code of rover…');
    await visitor.sees('It can no longer be used');
    await visitor.clicks('Cancel');
    // It stands in the list of all, too.
    await visitor.opens('#/servants');
    await visitor.sees('pairing code not used yet');
    // After a push one is paired there, for what was pushed.
    await visitor.opens('#/deploy');
    await (await visitor.page.waitForSelector('input[webkitdirectory]')).uploadFile(sources);
    await visitor.types('Programs with their arguments, one per line', 'adder.py');
    await visitor.clicks('Push');
    await visitor.sees('Published: adder_py, revision 1');
    await visitor.types("Robot's name", 'second');
    await visitor.clicks('Pair');
    await visitor.sees('Run on second, before');
    await visitor.page.waitForSelector('svg[role=img]');
    await visitor.judges('deploy-pairing');
    const second = (await visitor.elsewhere('GET', '/pairings')).find((one) => one.robot === 'second');
    assert.deepStrictEqual(second.services, ['adder_py']);
    await visitor.opens('#/servants');
    await visitor.sees('serves no robot');
    await visitor.chooses('Show', 'robots');
    await visitor.sees('2 of 3');
    await visitor.judges('servants-paired');
    await visitor.opens('#/access');
    await visitor.clicks('Revoke the code of second…');
    await visitor.clicks('Revoke it');
    await visitor.seesNot('Revoke the code of second…');
  },

  // Accounts, tokens, rules, and who did what.
  async admin(visitor) {
    await visitor.signsIn();
    await visitor.clicks('Access', 'link');
    await visitor.sees('Pair a robot');
    await visitor.judges('access-robots');
    await visitor.clicks('People', 'tab');
    await visitor.types('Name', 'eve');
    await visitor.types('Password, at least 12 characters', 'nine loud yellow kettles');
    await visitor.clicks('Create');
    await visitor.sees('Disable eve…');
    await visitor.judges('access-people');
    await visitor.clicks('Disable eve…');
    await visitor.clicks('Disable it');
    await visitor.sees('eve, disabled');
    await visitor.clicks('Tokens', 'tab');
    await visitor.types('Name', 'arm');
    await visitor.types('Robot name', 'arm');
    await visitor.types('Allowed classes, as patterns (default: none)', 'fast*');
    await visitor.types('Expires after (days; default: never)', '1');
    await visitor.clicks('Create');
    await visitor.sees('shown only once');
    await visitor.sees('Revoke arm…');
    await visitor.sees('classes fast*');
    await visitor.judges('access-tokens');
    await visitor.clicks('Revoke arm…');
    await visitor.clicks('Revoke it');
    await visitor.seesNot('Revoke arm…');
    await visitor.clicks('Policy', 'tab');
    await visitor.types('Who: a name, or a role such as role:robot', 'arm');
    await visitor.types('Grants, separated by spaces', 'subscribe:/sums nothing');
    await visitor.clicks('Add');
    await visitor.page.waitForSelector('.trouble');
    await visitor.types('Grants, separated by spaces', 'subscribe:/sums');
    await visitor.clicks('Add');
    await visitor.sees('subscribe:/sums');
    await visitor.judges('access-policy');
    await visitor.clicks('Audit log', 'tab');
    await visitor.sees('create a token');
    await visitor.judges('access-audit');
    await visitor.types('Find', 'no such words');
    await visitor.sees('No matches');
  },

  // Inside a servant of sights_py: what is drawn has the colours that its node gave it.
  async looker(visitor) {
    const { page } = visitor;
    await visitor.signsIn();
    await visitor.opens('#/servants');
    await visitor.clicks('rover', 'link');
    await visitor.clicks('Look inside', 'link');
    const chooses = (label, value) => visitor.chooses(label, value);
    // A pixel of the canvas that is there, at this share of its width and height, once it is of that colour.
    const pixel = (x, y, colour) => page.waitForFunction((x, y, colour) => {
      const canvas = document.querySelector('figure:not([hidden]) canvas');
      if (!canvas || !canvas.width) return false;
      const data = canvas.getContext('2d').getImageData(Math.floor(canvas.width * x), Math.floor(canvas.height * y), 1, 1).data;
      window.seen = [...data];
      return colour.every((one, index) => Math.abs(one - data[index]) <= 2);
    }, {}, x, y, colour).catch(async () => assert.fail(`at ${x}, ${y} is ${await page.evaluate(() => JSON.stringify(window.seen))} and not ${colour}`));
    const [RED, BLUE, BLACK, WHITE, UNKNOWN] = [[255, 0, 0], [0, 0, 255], [0, 0, 0], [255, 255, 255], [0, 0, 160]];
    for (const [encoding, left, right] of [
      ['rgb8', RED, BLUE], ['bgr8', RED, BLUE], ['rgba8', RED, BLUE], ['mono8', BLACK, WHITE], ['mono16', BLACK, WHITE],
      ['depth_16UC1', BLACK, WHITE], ['depth_32FC1', BLACK, UNKNOWN],
    ]) {
      await visitor.looksAt(`/sights/image/${encoding}`);
      await visitor.sees('640 × 480');
      await pixel(0.25, 0.5, left);
      await pixel(0.75, 0.5, right);
      if (encoding === 'depth_16UC1') await visitor.sees('0.50 m (black) to 2.50 m (white)');
      if (encoding === 'rgb8') {
        // Less is sent than is published, until somebody asks for all of it.
        await visitor.sees('rgb8 as JPEG');
        await visitor.judges('inside-picture');
        // Where the page says that viewers attach, one is greeted.
        const attaches = await page.$eval('a[href^="foxglove:"]', (link) => new URL(link.href).searchParams.get('ds.url'));
        const greeting = await page.evaluate((url) => new Promise((resolve, reject) => {
          const viewer = new WebSocket(url, ['foxglove.sdk.v1']);
          viewer.onmessage = ({ data }) => { resolve(JSON.parse(data)); viewer.close(); };
          viewer.onerror = () => reject(new Error(`${url} refuses`));
        }), `${attaches}?token=${token}`);
        assert.equal(greeting.op, 'serverInfo');
        // How fluid it is while thirty pictures come a second, beside the pictures.
        const fluid = await page.evaluate(async () => {
          const shown = () => Number(/(\d+) messages shown/.exec(document.body.innerText)?.[1] ?? 0);
          const [first, end] = [shown(), performance.now() + 4000];
          let frames = 0;
          while (performance.now() < end) {
            await new Promise(requestAnimationFrame);
            frames += 1;
          }
          return `${frames / 4} frames and ${(shown() - first) / 4} pictures of 640 × 480 a second\n`;
        });
        writeFileSync(join(pictures, 'inside-picture.txt'), fluid);
        await visitor.clicks('Full quality', 'checkbox');
        await visitor.seesNot('rgb8 as JPEG');
        await pixel(0.25, 0.5, left);
      }
    }
    await visitor.looksAt('/sights/image/odd');
    await visitor.sees('pictures of encoding yuv422 are not drawn');
    await visitor.looksAt('/sights/compressed');
    await visitor.sees('64 × 48, png');
    await pixel(0.25, 0.5, RED);
    await pixel(0.75, 0.5, BLUE);
    // A grid fills the view from the left to the right: the lowest ten of its sixty rows are unknown.
    await visitor.looksAt('/sights/map');
    await visitor.sees('100 × 60 cells of 0.05 m: 5 × 3 m; origin (lower left) at -2.5, -1 m of map');
    await pixel(0.25, 0.5, [254, 254, 254]);
    await pixel(0.75, 0.5, BLACK);
    await pixel(0.5, 0.86, [205, 205, 205]);
    await visitor.judges('inside-grid');
    await page.focus('canvas');
    for (let step = 0; step < 12; step += 1) await page.keyboard.press('ArrowRight');
    await pixel(0.25, 0.5, BLACK);
    await visitor.clicks('Show all');
    await pixel(0.25, 0.5, [254, 254, 254]);
    await visitor.looksAt('/sights/scan');
    await visitor.sees('361 beams, 121 of them in range');
    await visitor.sees('nearest 2 m, farthest 2 m');
    await visitor.judges('inside-scan');
    // Ahead is up, at two of the 2.2 metres that are in sight.
    const red = await page.evaluate(() => {
      const canvas = document.querySelector('canvas');
      const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
      const at = (x, y) => data[(Math.round(y) * canvas.width + Math.round(x)) * 4];
      const [middle, reach] = [canvas.width / 2, canvas.width / 2 / 1.1];
      return { ahead: at(middle, middle - reach), behind: at(middle, middle + reach * 0.97) };
    });
    assert(red.ahead > 150, JSON.stringify(red));
    // A number of it over time; and another topic beside it.
    await page.$eval('article summary', (summary) => summary.click());
    await visitor.clicks('plot range_max');
    await visitor.drawn('Plot of /sights/scan');
    await visitor.looksBeside('/sights/map');
    await page.waitForFunction(() => document.querySelectorAll('article').length === 2 && document.body.innerText.includes('100 × 60 cells'));
    await visitor.judges('inside-beside');
    for (const name of ['cloud', 'cloud_big_endian']) {
      await visitor.looksAt(`/sights/${name}`);
      await visitor.sees('10000 points in their colours; frame map');
      const halves = await page.waitForFunction(() => {
        const canvas = document.querySelector('figure:not([hidden]) canvas');
        const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        const count = { up: [0, 0], down: [0, 0] };
        for (let at = 0; at < data.length; at += 4) {
          if (!data[at + 3]) continue;
          const half = at / 4 / canvas.width < canvas.height / 2 ? count.up : count.down;
          half[data[at + 1] > 128 ? 0 : 1] += 1;
        }
        return count.up[0] + count.down[1] > 5000 && count;
      }).then((found) => found.jsonValue());
      // Green above, magenta below, but for the row between them.
      assert(halves.up[1] < halves.up[0] / 20 && halves.down[0] < halves.down[1] / 10, JSON.stringify(halves));
    }
    await visitor.clicks('Tilted');
    await visitor.judges('inside-cloud');
    await visitor.looksAt('');
    await visitor.clicks('Show the frames');
    await visitor.sees('base_link');
    await visitor.sees('rotated by 0, 0, 90°');
    await visitor.sees('egg → chicken → egg is a loop');
    await visitor.sees('torn has the parents map and odom');
    await visitor.sees('at 0.25, 0, 0 m');
    // Parameters keep their types.
    await visitor.clicks('Show the parameters');
    await visitor.clicks('/sights/scale');
    await page.waitForFunction(() => [...document.querySelectorAll('textarea')].some((one) => one.value === '2.0'));
    const value = await page.waitForSelector('::-p-aria([name="Value, as JSON"])');
    const writes = async (text) => {
      await value.click({ count: 3 });
      await value.type(text);
    };
    await writes('3');
    await visitor.sees('it is a floating-point number now and would become an integer');
    await writes('left');
    await visitor.sees('not valid JSON (strings need "quotes")');
    await visitor.clicks('Set the parameter');
    await visitor.page.waitForSelector('.trouble');
    await writes('2.5');
    await visitor.clicks('Set the parameter');
    await visitor.sees('/sights/scale is 2.5 (read back)');
    await visitor.clicks('/sights/limits/speed');
    await page.waitForFunction(() => [...document.querySelectorAll('textarea')].some((one) => one.value === '0.5'));
    await visitor.clicks('Remove the parameter…');
    await visitor.clicks('Remove it');
    await visitor.sees('/sights/limits/speed is removed');
    await visitor.judges('inside-parameters');
    // An action, its feedback and its end.
    await chooses('Action', '/sights/count');
    await visitor.fills('Goal of /sights/count', 'goal', '3');
    await visitor.clicks('Send the goal');
    await visitor.sees('the goal succeeded');
    // The same as JSON, which says what is wrong with it.
    const json = async (form, what, text) => {
      const box = await page.waitForSelector(`form[aria-label="${form}"] ::-p-aria([name="${what}, as JSON"])`);
      await box.evaluate((area, text) => { area.value = text; area.dispatchEvent(new Event('input', { bubbles: true })); }, text);
    };
    const otherView = async (form) => (await page.waitForSelector(`form[aria-label="${form}"] ::-p-aria([name="as JSON"][role="checkbox"])`)).click();
    await otherView('Goal of /sights/count');
    await page.waitForFunction(() => [...document.querySelectorAll('textarea')].some((one) => one.value.includes('"goal": 3')));
    await json('Goal of /sights/count', 'Goal', '{"goal": 1000');
    await visitor.sees('the goal is not valid JSON');
    await visitor.judges('inside-no-json');
    await json('Goal of /sights/count', 'Goal', '{"goal": 1000}');
    await visitor.seesNot('the goal is not valid JSON');
    await otherView('Goal of /sights/count');
    await page.waitForFunction(() => document.querySelector('form[aria-label^="Goal"] input[type=number]').value === '1000');
    await visitor.clicks('Send the goal');
    await visitor.sees('feedback');
    await visitor.clicks('Cancel the goal');
    await visitor.sees('the goal was cancelled');
    await chooses('Service', '/sights/ping');
    await visitor.sees('No fields.');
    await visitor.clicks('Call');
    await visitor.sees('pong');
    await chooses('Service', '/sights/set_logger_level');
    await visitor.fills('Call /sights/set_logger_level', 'logger', 'rosout');
    await visitor.fills('Call /sights/set_logger_level', 'level', 'debug');
    await visitor.clicks('Call');
    await page.waitForFunction(() => /answer\s+0 fields/.test(document.body.innerText));
    // What is published goes through its node: by the fields of a text, of a message within a message, and of a list.
    await visitor.looksAt('/sights/say');
    await visitor.writesTo('/sights/say');
    await visitor.fills('Publish on /sights/say', 'data', 'by the form');
    await visitor.clicks('Publish');
    await visitor.sees('"by the form"');
    await visitor.looksAt('/tf');
    await visitor.writesTo('/tf');
    // Messages that come meanwhile may move the button away from under the pointer.
    const added = '::-p-aria([name="transforms[0].child_frame_id"])';
    for (let tries = 0; tries < 30 && !(await page.$(`form[aria-label="Publish on /tf"] ${added}`)); tries += 1) {
      await visitor.clicks('Add to transforms');
      await page.waitForSelector(`form[aria-label="Publish on /tf"] ${added}`, { timeout: 2000 }).catch(() => {});
    }
    await visitor.fills('Publish on /tf', 'transforms[0].child_frame_id', 'held');
    for (const part of ['header', 'transform', 'rotation']) await page.locator(`form[aria-label="Publish on /tf"] details:not([open]) ::-p-text(${part})`).click();
    await visitor.fills('Publish on /tf', 'transforms[0].header.frame_id', 'base_link');
    await visitor.clicks('Now as transforms[0].header.stamp');
    await visitor.fills('Publish on /tf', 'transforms[0].transform.rotation.w', '1');
    await visitor.judges('inside-fields');
    await visitor.clicks('Publish');
    await visitor.sees('held');
    // Bytes are a text, and as many as a camera's picture has are not drawn one by one.
    await visitor.looksAt('/sights/image/odd');
    await visitor.writesTo('/sights/image/odd');
    await visitor.fills('Publish on /sights/image/odd', 'data', '1 2 0xff');
    await visitor.sees('3 bytes');
    await otherView('Publish on /sights/image/odd');
    await json('Publish on /sights/image/odd', 'Message', JSON.stringify({ data: Buffer.alloc(640 * 480 * 3).toString('base64') }));
    await otherView('Publish on /sights/image/odd');
    await page.waitForFunction(() => document.querySelector('form[aria-label="Publish on /sights/image/odd"] input[readonly]').value.startsWith('921600 bytes'));
    await visitor.looksAt('');
    // How much flows on each topic, counted while it is asked for.
    await visitor.clicks('Show rates');
    await page.waitForFunction(() => [...document.querySelectorAll('section[aria-labelledby="topics"] tr')].some((row) => /^\/sights\/scan[^]*\d\s(ms|s)\b/.test(row.innerText)));
    await visitor.judges('inside-counted');
    await visitor.clicks('Hide rates');
    // What became of the goals, and a recording of the last seconds.
    await visitor.clicks('Instance (servant)', 'link');
    await visitor.sees('Action goals');
    await page.waitForFunction(() => ['succeeded', 'cancelled'].every((word) => document.querySelector('section[aria-labelledby="goals"]').innerText.includes(word)));
    await visitor.sees('somebody who looks inside');
    await visitor.clicks('Record the last seconds now');
    await visitor.sees('asked for it');
    await visitor.judges('servant-goals');
    const fetched = page.waitForResponse((answer) => answer.url().includes('/api/v1/recordings/'));
    await visitor.clicks('Download recording 1');
    assert.strictEqual((await fetched).status(), 200);
  },

  // The recording goes.
  async clearer(visitor) {
    await visitor.signsIn();
    await visitor.opens('#/servants');
    await visitor.clicks('rover', 'link');
    await visitor.clicks('Remove 1…');
    await visitor.clicks('Remove it');
    await visitor.sees('No recordings.');
  },

  // Inside a servant of ROS 2, whose types rosapi calls otherwise, and whose nodes may not have found each other when the page is opened.
  async ros2(visitor) {
    const { page } = visitor;
    await page.waitForSelector('nav');
    await visitor.opens('#/servants');
    await visitor.clicks('rover', 'link');
    await visitor.clicks('Look inside', 'link');
    await visitor.looksAt('/sights/image');
    await visitor.sees('640 × 480, rgb8 as JPEG');
    await visitor.clicks('Full quality', 'checkbox');
    await visitor.sees('640 × 480, rgb8');
    await visitor.seesNot('rgb8 as JPEG');
    await visitor.looksAt('/sights/scan');
    await visitor.sees('361 beams, 121 of them in range');
    await page.$eval('article summary', (summary) => summary.click());
    await visitor.clicks('plot range_max');
    await visitor.drawn('Plot of /sights/scan');
    await visitor.looksAt('/sights/say');
    await visitor.writesTo('/sights/say');
    await visitor.fills('Publish on /sights/say', 'x', '1.5');
    await visitor.clicks('Publish');
    await visitor.sees('sent');
    await visitor.looksBeside('/sights/said');
    await visitor.sees('at 1.5 0');
    await visitor.chooses('Service', '/sights/switch');
    const data = await page.waitForSelector('form[aria-label="Call /sights/switch"] ::-p-aria([name="data"][role="checkbox"])');
    await data.click();
    await visitor.clicks('Call');
    await visitor.sees('it is on');
    // Nobody publishes transforms, and that is no mistake of whoever asks.
    await visitor.clicks('Show the frames');
    await visitor.sees('no transforms yet');
    await visitor.clicks('Show the parameters');
    await visitor.clicks('/sights:use_sim_time');
    await page.waitForFunction(() => [...document.querySelectorAll('textarea')].some((one) => one.value === 'false'));
    assert.strictEqual(await page.$('.trouble'), null);
    await visitor.judges('inside-ros2');
  },

  // Settings of Debian's people_detect, where nobody has to say who he is.
  async settings(visitor) {
    const { page } = visitor;
    await page.waitForSelector('nav');
    // On a server that is open one looks, and is told how to do more.
    await visitor.sees('You may look at everything and change nothing.');
    await visitor.sees('sudo cloudroidctl account create NAME --role admin');
    assert.deepStrictEqual(await visitor.pages(), ['Overview', 'Services', 'Robots and servants', 'Events']);
    await visitor.judges('local');
    await visitor.opens('#/servants');
    await visitor.clicks('settings', 'link');
    await visitor.clicks('Look inside', 'link');
    await visitor.chooses('Node', '/people_detect');
    const padding = await page.waitForSelector('::-p-aria([name="padding"][role="spinbutton"])');
    await padding.click({ count: 3 });
    await padding.type('16');
    await page.keyboard.press('Tab');
    await visitor.sees('padding is 16 (confirmed by /people_detect)');
    // The slider stands where the node said, and is moved by a key.
    const slider = await page.waitForSelector('input[type=range][aria-label^="padding"]');
    assert.strictEqual(await slider.evaluate((range) => range.value), '16');
    await slider.focus();
    await page.keyboard.press('ArrowRight');
    await visitor.sees('padding is 17 (confirmed by /people_detect)');
    assert.strictEqual(await padding.evaluate((box) => box.value), '17');
    const camera = await page.waitForSelector('::-p-aria([name="use_camera_info"][role="checkbox"])');
    await camera.click();
    await visitor.sees('use_camera_info is true (confirmed by /people_detect)');
    await visitor.judges('inside-settings');
  },

  // Who may see it hears, and does nothing.
  async onlooker(visitor) {
    const { page } = visitor;
    await visitor.signsIn();
    await visitor.opens('#/servants');
    await visitor.clicks('rover', 'link');
    await visitor.clicks('Look inside', 'link');
    await visitor.looksAt('/sights/image/rgb8');
    await visitor.sees('640 × 480, rgb8');
    await visitor.looksAt('/sights/say');
    await visitor.writesTo('/sights/say');
    await visitor.fills('Publish on /sights/say', 'data', 'not for me');
    await visitor.clicks('Publish');
    await visitor.isRefused('publish:/sights/say is not granted');
    await visitor.chooses('Action', '/sights/count');
    await visitor.fills('Goal of /sights/count', 'goal', '3');
    await visitor.clicks('Send the goal');
    await visitor.isRefused('call:/sights/count is not granted');
    await visitor.chooses('Service', '/sights/ping');
    await visitor.clicks('Call');
    await visitor.isRefused('call:/sights/ping is not granted');
    await visitor.clicks('Show the parameters');
    await visitor.isRefused('call:/rosapi/get_param_names is not granted');
    await visitor.judges('inside-refused');
    // Recordings are looked at, and neither made nor removed.
    await visitor.clicks('Instance (servant)', 'link');
    await visitor.sees('asked for it');
    await visitor.offersNone(/^(Record|Remove)/);
    await visitor.judges('recordings-viewer');
  },

  // Who may look and nothing else is told so, and offered nothing that would be refused.
  async viewer(visitor) {
    const { page } = visitor;
    await visitor.signsIn();
    await visitor.sees('viewer (viewer) may look and change nothing.');
    await visitor.sees('cloudroidctl token create NAME --role operator');
    assert.deepStrictEqual(await visitor.pages(), ['Overview', 'Services', 'Robots and servants', 'Events']);
    await visitor.opensKnowing('#/services/adder_py', 'adder_py');
    await visitor.sees('Last deploy');
    await visitor.sees('The table is empty');
    await visitor.offersNone(/revision|canary|Remove|Pair|Measure/);
    await visitor.judges('service-viewer');
    await visitor.opens('#/services/adder_py/calibrate');
    await visitor.sees('You may not measure this service');
    await visitor.opens('#/servants');
    await visitor.clicks('rover', 'link');
    await visitor.drawn('Response time (RRT)');
    await visitor.offersNone(/^(Stop|Set|Log|Record)/);
    await visitor.judges('servant-viewer');
    await page.evaluate(() => { location.hash += '/log'; });
    await visitor.sees('You may not read its log');
    await visitor.judges('log-viewer');
    await visitor.opens('#/deploy');
    await visitor.sees('You may not deploy packages here');
    await visitor.opens('#/access');
    await visitor.sees('You may neither pair robots nor manage accounts');
    await visitor.judges('access-viewer');
  },

  // Who may see other services alone.
  async stranger(visitor) {
    visitor.mayBeRefused = true;
    await visitor.signsIn();
    await visitor.sees('No service is published yet');
    await visitor.sees('No events yet');
    await visitor.seesNot('Cores reserved');
    await visitor.opens('#/servants');
    await visitor.sees('No robots connected');
    await visitor.opens('#/services/adder_py');
    await visitor.sees('may not see service adder_py');
    await visitor.judges('stranger');
  },

  // A hundred servants that change each second cost few frames, and an hour of that leaves nothing behind. What the daemon would say
  // is said in its place: nobody has a hundred robots at hand, nor an hour.
  async many(visitor) {
    const { page } = visitor;
    await page.evaluateOnNewDocument(() => {
      const asked = window.fetch;
      // What the machine is, the daemon itself has told.
      window.machine = async (headers) => {
        const reader = (await asked('/api/v1/stream', { headers })).body.pipeThrough(new TextDecoderStream()).getReader();
        let text = '';
        while (!text.includes('\n\n')) text += (await reader.read()).value;
        await reader.cancel();
        return JSON.parse(/^data: (.*)$/m.exec(text)[1]).machine;
      };
      window.fetch = (input, options) => {
        const says = String(input).endsWith('/api/v1/stream') ? 'says' : String(input).includes('/logs?') ? 'prints' : undefined;
        if (!says) return asked(input, options);
        const body = new ReadableStream({ start(controller) { window[says] = (text) => controller.enqueue(new TextEncoder().encode(text)); } });
        return Promise.resolve(new Response(body));
      };
    });
    await page.reload();
    await visitor.signsIn();
    await page.waitForFunction(() => window.says);
    // Frames, and how far they are apart: beside those of a page without anything to show.
    const frames = (during) => page.evaluate(async (during) => {
      const [gaps, end] = [[], performance.now() + during];
      let last = performance.now();
      while (last < end) {
        await new Promise(requestAnimationFrame);
        const now = performance.now();
        gaps.push(now - last);
        last = now;
      }
      gaps.sort((a, b) => a - b);
      const at = (share) => gaps[Math.floor((gaps.length - 1) * share)];
      return { count: gaps.length, p50: at(0.5), p95: at(0.95), longest: at(1) };
    }, during);
    const idle = await frames(5_000);
    const machine = await page.evaluate(() => window.machine({ Authorization: `Bearer ${sessionStorage.getItem('token')}` }));
    await page.evaluate((machine) => {
      const random = (most) => Math.random() * most;
      const served = (index) => ({
        servant: {
          id: `s${index}`, service: 'adder', revision: 1, robot: `rover${index}`, phase: 'ready', created: Date.now() - 60_000, connections: 1, limits: {},
          cgroup_version: 2, usage: { cpu_usec: 0, memory: random(1e8), pids: 3, oom_kills: 0, throttled_usec: 0 },
          response: { requests: 100, p50_ms: random(50), p95_ms: random(200) }, pids: [], dropped: 0, down: [], hung: [], lifecycle: [],
        },
        // One of them is unhappy.
        throttled: random(1), cores: random(1), links: index ? [] : [{ node: '/adder', up: false, requests: 10, late: 3, local: 0, dropped: 0, drops: [], phases: [] }],
      });
      let [time, event] = [Date.now(), 0];
      window.second = (servants, kind = 'update') => {
        time += 1000;
        event += 1;
        const events = [{ id: event, time, level: 'info', kind: 'test', message: `the ${event}th` }];
        machine.cores = random(2);
        const data = { time, servants: Array.from({ length: servants }, (_, index) => served(index)), events, machine, ...(kind === 'snapshot' ? { back_offs: [] } : {}) };
        window.says(`event: ${kind}\ndata: ${JSON.stringify(data)}\n\n`);
      };
      window.second(100, 'snapshot');
    }, machine);
    await visitor.opens('#/servants');
    await visitor.sees('100 of 100');
    await page.evaluate(() => { window.going = setInterval(() => window.second(100), 1000); });
    const busy = await frames(5_000);
    await page.evaluate(() => clearInterval(window.going));
    const told = (name, { count, p50, p95, longest }) => `${name}: ${count} frames in 5 s, apart ${p50.toFixed(1)} ms (median), ${p95.toFixed(1)} ms (95 %), ${longest.toFixed(1)} ms (longest)`;
    const both = `${told('a page that rests', idle)}\n${told('100 servants that change each second', busy)}\n`;
    console.log(both);
    writeFileSync(join(pictures, 'servants-hundred.txt'), both);
    assert(busy.count > idle.count * 0.8 && busy.p50 < idle.p50 * 1.5 && busy.p95 < idle.p95 * 3, both);
    await visitor.judges('servants-hundred');

    // An hour: half of it is what is kept at the most, the other must add nothing.
    await visitor.opens('#/servants/s1');
    await visitor.sees('Performance');
    const session = await page.createCDPSession();
    const passes = async (seconds) => {
      await page.evaluate(async (seconds) => {
        for (let second = 0; second < seconds; second += 1) {
          window.second(3);
          if (second % 10 === 0) await new Promise(requestAnimationFrame);
        }
        await new Promise(requestAnimationFrame);
      }, seconds);
      await session.send('HeapProfiler.collectGarbage');
      const { JSHeapUsedSize, Nodes, JSEventListeners } = await page.metrics();
      return { heap: JSHeapUsedSize, nodes: Nodes, listeners: JSEventListeners };
    };
    const growsBy = async (seconds, where) => {
      const half = await passes(seconds);
      const whole = await passes(seconds);
      console.log(where, half, whole);
      assert(whole.heap < half.heap * 1.1 && whole.nodes < half.nodes * 1.1 && whole.listeners <= half.listeners * 1.1, JSON.stringify({ where, half, whole }));
    };
    await growsBy(1800, 'one servant');
    // What is kept at the most is kept by now: on the other pages less time tells the same.
    await visitor.opens('#/');
    await visitor.sees('Cores reserved');
    await visitor.sees('100 robots served, 1 of 100 late');
    await visitor.sees('rover0 at adder: the link of /adder is down');
    await visitor.sees('88 more instances');
    await visitor.judges('overview-unhappy');
    await growsBy(300, 'overview');
    await visitor.opens('#/events');
    await page.waitForFunction(() => /the \d+th/.test(document.querySelector('main').innerText));
    await growsBy(300, 'events');
    await visitor.opens('#/servants/s1/log');
    await page.waitForFunction(() => window.prints);
    await page.evaluate(() => {
      const { second } = window;
      let line = 0;
      // Twenty lines a second, in all the colours that programs have.
      window.second = (servants) => {
        second(servants);
        for (let more = 0; more < 20; more += 1) {
          line += 1;
          const codes = [`3${line % 8}`, `9${line % 8}`, `38;5;${line % 256}`, `48;5;${line % 256}`, `7;38;5;${line % 256}`, `1;4;38;2;${line % 256};${line % 200};${line % 90}`, `97;10${line % 8}`];
          window.prints(`${JSON.stringify({ time: Date.now(), node: '/adder', stream: 'stdout', line: `\x1b[${codes[line % codes.length]}mline ${line}\x1b[0m of many` })}\n`);
        }
      };
    });
    await growsBy(300, 'log');
    await visitor.sees('line 12000');
    // As many as axe-core looks through in a moment.
    await visitor.types('Find', 'line 1198');
    await visitor.sees('10 of 5000 lines');
    await visitor.judges('log-colours');
  },

  // Is told at once that it is not let in any more: who started this waits for `looks` and revokes.
  async revoked(visitor) {
    await visitor.signsIn();
    await visitor.sees('Overview');
    console.log('looks');
    await visitor.sees('was revoked');
    await visitor.sees('With a token');
    await visitor.judges('revoked');
  },

  // A canary is begun by the options that the command line has, and becomes the current revision.
  async canary(visitor) {
    await visitor.signsIn();
    await visitor.opens('#/deploy');
    await (await visitor.page.waitForSelector('input[webkitdirectory]')).uploadFile(sources);
    await visitor.sees('Chosen: the folder adder_py');
    await visitor.types('Programs with their arguments, one per line', 'adder.py');
    await visitor.page.locator('form details ::-p-text(Rollout and canary)').click();
    await visitor.types('Robots served by it first (default: all at once)', '1');
    await visitor.types('Stop servants of other revisions after (default: when their robots leave)', 'soon');
    await visitor.clicks('Push');
    await visitor.sees('is not a time');
    await visitor.types('Stop servants of other revisions after (default: when their robots leave)', '1s');
    await visitor.sees('Rollout and canary, 2 set');
    await visitor.page.locator('form details ::-p-text(Response times and what robots may request)').click();
    await visitor.types('Maximum memory that a robot may request', '256M');
    await visitor.judges('deploy-more');
    await visitor.clicks('Push');
    await visitor.sees('revision 2, as a canary beside revision 1');
    await visitor.opens('#/services/adder_py');
    await visitor.sees('Rollout from revision 1 to 2');
    await visitor.page.waitForFunction(() => document.querySelector('section[aria-labelledby="differences"]')?.innerText.includes('cap'));
    await visitor.judges('service-canary');
    await visitor.clicks('Promote…');
    await visitor.clicks('Promote it');
    await visitor.page.waitForFunction(() => /promoted|draining/.test(document.querySelector('section[aria-labelledby="rollout"]').innerText));
  },

  // Who may look while a canary is under way.
  async bystander(visitor) {
    await visitor.signsIn();
    await visitor.opensKnowing('#/services/adder_py', 'adder_py');
    await visitor.sees('Rollout from revision 2 to 3');
    await visitor.offersNone(/Promote|Abort/);
    await visitor.judges('service-canary-viewer');
  },

  // Another canary is taken back.
  async aborter(visitor) {
    await visitor.signsIn();
    await visitor.opens('#/services/adder_py');
    const rollout = (words) => visitor.page.waitForFunction((words) => document.querySelector('section[aria-labelledby="rollout"]')?.innerText.includes(words), {}, words);
    // By another client: it is seen here without doing anything.
    await visitor.sees('Abort…');
    await visitor.elsewhere('POST', '/services/adder_py/rollout', { order: 'abort' });
    await rollout('aborted');
    // A revision that is there is tried again.
    await visitor.clicks('Start revision 3 as a canary…');
    await visitor.types('Number of robots, or percentage of new robots', 'some');
    await visitor.clicks('Start the canary');
    await visitor.sees('not a share of robots');
    await visitor.judges('try-revision');
    await visitor.types('Number of robots, or percentage of new robots', '25%');
    await visitor.clicks('Start the canary');
    await rollout('25% of the robots');
    await visitor.clicks('Abort…');
    await visitor.sees('Abort the rollout of revision 3?');
    await visitor.clicks('Abort the rollout');
    await rollout('aborted');
  },

  // What response times cost, measured at the requests from a connected robot.
  async calibrator(visitor) {
    await visitor.signsIn();
    await visitor.opens('#/services/teller_py');
    await visitor.clicks('Measure response times', 'link');
    await visitor.sees('Requests to replay');
    // A recording: cancelled while it is sent, and then measured.
    const file = await visitor.page.waitForSelector('input[type=file][accept=".bag"]');
    await file.uploadFile(process.env.RECORDING);
    await visitor.types('CPU limits to test, in cores (default: automatic steps)', '1');
    await visitor.types('Requests at each limit (default: 40)', '5');
    await visitor.clicks('Calibrate');
    await visitor.isRefused('requests = 5 is not between 10');
    await visitor.types('Requests at each limit (default: 40)', '10');
    await visitor.page.locator('::-p-aria([name="send the next request as soon as one is answered"][role="checkbox"])').click();
    const fast = await visitor.slowly(200_000);
    const sending = () => visitor.page.waitForFunction(() => /sending, [1-9]\d?\s% of/.test(document.body.innerText));
    await visitor.clicks('Calibrate');
    await sending();
    await visitor.clicks('Cancel');
    await visitor.sees('Cancelled: nothing was written.');
    await visitor.clicks('Calibrate');
    await sending();
    await fast();
    const measured = () => visitor.page.waitForFunction(() => /Proposed SLA entries|No entries proposed/.test(document.body.innerText), { timeout: 3 * PATIENCE });
    await measured();
    await visitor.sees('10 of 10');
    await visitor.sees('that teller_py has no input for: /noise');
    await visitor.judges('calibrate-recording');
    await visitor.page.locator('::-p-aria([name="from a connected robot"][role="radio"])').click();
    await visitor.chooses('Robot', 'talker');
    await visitor.types('CPU limits to test, in cores (default: automatic steps)', '0.5, 1');
    await visitor.clicks('Calibrate');
    await visitor.seesNot('Proposed SLA entries');
    await visitor.seesNot('No entries proposed');
    await visitor.sees('Measurements');
    // Its own patience: it listens for ten seconds, and then it measures.
    await measured();
    await visitor.judges('calibrate');
    // What it proposes stands with its curve beside the service then. A robot that is slowed by all that runs here may get no row.
    const rows = await visitor.page.$$eval('h3 + ul li', (all) => all.length);
    if (!rows) return;
    await visitor.clicks('Write them to the SLA table');
    await visitor.sees('Written: the SLA table now has');
    await visitor.opens('#/services/teller_py');
    await visitor.sees('SLA table');
    await visitor.sees('Calibrate again');
    assert.equal((await visitor.page.$$('section[aria-labelledby="dictionary"] polyline')).length, rows > 1 ? 2 : 0, 'a curve of median and 95 %');
    await visitor.judges('dictionary');
  },

  // The robot's servant is stopped, and the service removed.
  async remover(visitor) {
    // What is shown of a service may be asked for while it goes.
    visitor.mayBeRefused = true;
    await visitor.signsIn();
    await visitor.opens('#/servants');
    await visitor.clicks('rover', 'link');
    await visitor.clicks('Stop…');
    await visitor.clicks('Stop it');
    await visitor.sees('It has ended');
    // What is recorded of it is there when the page is opened anew.
    const hash = await visitor.page.evaluate(() => location.hash);
    await visitor.page.reload();
    await visitor.sees('It has ended. The data below was recorded');
    assert.strictEqual(await visitor.page.evaluate(() => location.hash), hash);
    const median = () => [...document.querySelectorAll('figure')].some((one) => one.innerText.startsWith('Response time') && /p50\s*[\d.]+\sms/.test(one.innerText));
    await visitor.page.waitForFunction(median);
    const plots = await visitor.plots();
    assert(plots.includes('Memory') && !plots.some((title) => title.startsWith('Satisfaction')), plots.join());
    await visitor.sees('is ready for rover');
    await visitor.judges('servant-ended');
    // So is what it printed.
    await visitor.sees('Reason: it was stopped');
    await visitor.clicks('Log', 'link');
    await visitor.sees('the servant has ended');
    await visitor.sees('the sum is negative');
    await visitor.page.waitForSelector('.log .ansi-yellow');
    await visitor.judges('log-ended');
    await visitor.opens('#/servants');
    await visitor.sees('serves no robot');
    await visitor.judges('servants-none');
    await visitor.chooses('Show', 'ended');
    await visitor.page.waitForFunction(() => /ended \d+ (s|min) ago/.test(document.querySelector('tbody')?.innerText));
    await visitor.judges('servants-ended');
    await visitor.clicks('rover', 'link');
    await visitor.sees('It has ended');
    await visitor.opens('#/services/adder_py');
    await visitor.clicks('Remove…');
    await visitor.clicks('Remove it');
    await visitor.sees('No service is published yet');
  },
};

async function main() {
  mkdirSync(pictures, { recursive: true });
  const browser = await puppeteer.launch({
    executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
    // Of the daemon's own certificate nobody has told the browser.
    acceptInsecureCerts: true,
    // On a busy machine the browser may be minutes late; each step has a limit of its own.
    protocolTimeout: 0,
    args: ['--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage', '--disable-background-networking', '--disable-component-update'],
  });
  try {
    const visitor = new Visitor(await browser.newPage());
    await visitor.page.setViewport(LAPTOP);
    await visitor.page.goto(url);
    try {
      await STEPS[step](visitor);
    } catch (error) {
      await visitor.page.screenshot({ path: `${pictures}/failed-${step}.png`, fullPage: true });
      throw error;
    }
    assert.deepStrictEqual(visitor.wrong, [], 'what the page did wrong');
    if (!visitor.mayBeRefused) assert.deepStrictEqual(visitor.refused, [], 'what the daemon refused');
  } finally {
    await browser.close();
  }
}

main().catch((error) => { console.error(error); process.exit(1); });
