// Polls /api/v1 and shows it. Everything that comes from there is put in as text, never as markup.
"use strict";

const PERIOD = 1500;
const byId = (id) => document.getElementById(id);
let token = sessionStorage.getItem("token") || "";
let chosen = null;
let csrf = ""; // of the session that the browser shows by its cookie
let earlier = new Map(); // servant → {time, cpu} of the last poll

async function ask(path, options = {}) {
  const headers = { ...options.headers };
  if (token) headers.Authorization = `Bearer ${token}`;
  else if (csrf) headers["X-CSRF-Token"] = csrf;
  const answer = await fetch(`/api/v1${path}`, { ...options, headers, cache: "no-store" });
  if (!answer.ok) {
    const problem = await answer.json().catch(() => ({}));
    throw Object.assign(new Error(problem.detail || answer.statusText), { status: answer.status });
  }
  return answer.status === 204 ? null : answer.json();
}

// Who is signed in, and by what somebody could sign in.
function showPerson(session) {
  csrf = session.csrf || "";
  byId("person").hidden = !csrf;
  byId("name").textContent = csrf ? `${session.name} (${session.role})` : "";
  const asked = session.needed && !session.name;
  byId("sign-in").hidden = !(asked && session.accounts);
  byId("login").hidden = !asked;
}

async function recognise() {
  const wrong = (error) => { if (error.status !== 401) throw error; };
  try {
    showPerson(await ask("/session"));
  } catch (error) {
    wrong(error);
    // The token that was given is not good: without it the daemon says by what somebody could sign in.
    token = "";
    sessionStorage.removeItem("token");
    showPerson(await ask("/session"));
    throw error;
  }
}

function element(name, content, className) {
  const made = document.createElement(name);
  made.append(...[].concat(content ?? ""));
  if (className) made.className = className;
  return made;
}

const row = (...cells) => element("tr", cells.map((cell) => (cell instanceof HTMLTableCellElement ? cell : element("td", cell))));
const name = (text) => element("td", text, "name");

function size(bytes) {
  const units = ["B", "KB", "MB", "GB", "TB"];
  let unit = 0;
  while (bytes >= 1024 && unit < units.length - 1) { bytes /= 1024; unit += 1; }
  return `${bytes >= 10 || unit === 0 ? Math.round(bytes) : bytes.toFixed(1)} ${units[unit]}`;
}

function age(then) {
  const seconds = Math.max(0, Math.floor((Date.now() - then) / 1000));
  if (seconds < 120) return `${seconds} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.floor(seconds / 3600)} h` : `${Math.floor(seconds / 86400)} d`;
}

function limits(of) {
  const parts = [];
  if (of.cpus != null) parts.push(`${of.cpus} cpus`);
  if (of.memory != null) parts.push(size(of.memory));
  if (of.pids != null) parts.push(`${of.pids} pids`);
  return parts.join(", ") || "none";
}

function gauge(used, all, text) {
  const meter = document.createElement("meter");
  meter.max = all || 1;
  meter.value = used;
  return [meter, ` ${text}`];
}

function showMachine(status) {
  byId("daemon").textContent = `${status.version} · up ${age(status.started)} · ${status.listen} · state in ${status.home}`;
  const room = status.capacity;
  const version = status.isolation.cgroup_version;
  const facts = [
    ["Cores promised", gauge(room.cpus_reserved, room.cpus, `${+room.cpus_reserved.toFixed(2)} of ${room.cpus}`)],
    ["Memory promised", gauge(room.memory_reserved, room.memory, `${size(room.memory_reserved)} of ${size(room.memory)}`)],
    ["Servants", `${status.servants} (${status.spares} ready for more)`],
    ["Connections", String(status.connections)],
    ["Waiting for room", String(room.waiting)],
    ["Limits enforced by", version ? `cgroup v${version}` : "nothing"],
    ["Default service", status.default_service || "none"],
  ];
  byId("machine").replaceChildren(...facts.map(([term, fact]) => element("div", [element("dt", term), element("dd", fact)])));
  byId("warnings").replaceChildren(...status.warnings.map((text) => element("li", text)));
}

function showServices(services) {
  byId("no-services").hidden = services.length > 0;
  byId("services").replaceChildren(...services.map((service) => {
    const open = element("button", service.name, "link");
    open.type = "button";
    open.addEventListener("click", () => { chosen = chosen === service.name ? null : service.name; look(); });
    const counts = [[service.topics, "topic"], [service.services, "service"], [service.actions, "action"],
      [service.parameters, "parameter"]].filter(([count]) => count > 0).map(([count, what]) => `${count} ${what}${count === 1 ? "" : "s"}`).join(", ");
    return row(open, String(service.revision), `${age(service.published)} ago`, counts, String(service.servants),
      limits(service.limits), name(service.address));
  }));
}

function showDetail(service) {
  byId("detail").hidden = !service;
  if (!service) return;
  byId("detail-title").textContent = `Interface of ${service.name}`;
  const marks = (topic) => [topic.latched && "latched", topic.lazy && "lazy"].filter(Boolean).join(", ");
  byId("interface").replaceChildren(
    ...service.interface.topics.map((topic) => row(topic.direction, name(topic.name), name(topic.type), marks(topic))),
    ...service.interface.services.map((entry) => row("service", name(entry.name), name(entry.type), "")),
    ...service.interface.needs.map((entry) => row("needs service", name(entry.name), "", entry.nodes.join(", "))),
    ...service.interface.actions.map((entry) => row("action", name(entry.name), name(entry.type), "")),
    ...service.interface.parameters.map((entry) =>
      row("parameter", name(entry.name), "", entry.value === undefined ? "" : JSON.stringify(entry.value))),
  );
}

function showServants(servants) {
  byId("no-servants").hidden = servants.length > 0;
  const now = performance.now();
  const seen = new Map();
  byId("servants").replaceChildren(...servants.map((servant) => {
    const usage = servant.usage;
    const before = earlier.get(servant.id);
    let cpu = "";
    if (usage) {
      seen.set(servant.id, { time: now, cpu: usage.cpu_usec });
      if (before && now > before.time) cpu = `${Math.round((usage.cpu_usec - before.cpu) / (now - before.time) / 10)} %`;
    }
    if (usage?.throttled_usec) cpu += `, throttled ${(usage.throttled_usec / 1e6).toFixed(1)} s`;
    const waits = Object.entries(usage?.pressure ?? {}).filter(([, percent]) => percent >= 1);
    if (waits.length) cpu += `, waits for ${waits.map(([what, percent]) => `${what} ${Math.round(percent)} %`).join(", ")}`;
    const idle = servant.idle_until ? ` (idle, ends in ${Math.max(0, Math.round((servant.idle_until - Date.now()) / 1000))} s)` : "";
    const state = element("td", `${servant.phase}${idle}${servant.reason ? `: ${servant.reason}` : ""}`, servant.phase);
    return row(name(servant.id), `${servant.service}:${servant.revision}`, servant.robot, state, age(servant.created),
      String(servant.connections), cpu, usage ? size(usage.memory) : "", limits(servant.enforced || servant.limits));
  }));
  earlier = seen;
}

function showEvents(events) {
  byId("events").replaceChildren(...events.reverse().map((event) => {
    const time = element("time", new Date(event.time).toLocaleTimeString());
    time.dateTime = new Date(event.time).toISOString();
    return element("li", [time, element("span", event.message, event.level)]);
  }));
}

async function look() {
  try {
    const ofAll = ask("/status").catch((error) => { if (error.status !== 403) throw error; return null; });
    const [status, services, servants, events] = await Promise.all(
      [ofAll, ...["/services", "/servants", "/events?limit=30"].map((path) => ask(path))]);
    if (!services.some((service) => service.name === chosen)) chosen = null;
    const detail = chosen ? await ask(`/services/${encodeURIComponent(chosen)}`) : null;
    byId("trouble").hidden = byId("login").hidden = byId("sign-in").hidden = true;
    // Who is for some services is not told of the machine.
    if (status) showMachine(status);
    else byId("daemon").textContent = "";
    showServices(services);
    showDetail(detail);
    showServants(servants);
    showEvents(events);
  } catch (error) {
    // Who is about to sign in reads what was wrong with it.
    if (error.status === 401 && !byId("sign-in").hidden) return;
    byId("trouble").hidden = false;
    byId("trouble").textContent = error.status ? error.message : "the daemon does not answer";
    if (error.status === 401) await recognise().catch(() => {});
  }
}

byId("login").addEventListener("submit", (event) => {
  event.preventDefault();
  token = byId("token").value;
  sessionStorage.setItem("token", token);
  look();
});

byId("sign-in").addEventListener("submit", async (event) => {
  event.preventDefault();
  const body = JSON.stringify({ name: byId("account").value, password: byId("password").value });
  byId("password").value = "";
  try {
    showPerson(await ask("/session", { method: "POST", body, headers: { "Content-Type": "application/json" } }));
    await look();
  } catch (error) {
    byId("trouble").hidden = false;
    byId("trouble").textContent = error.message;
  }
});

byId("sign-out").addEventListener("click", async () => {
  await ask("/session", { method: "DELETE" }).catch(() => {});
  // What was shown to one is not left for the next.
  location.reload();
});

async function poll() {
  if (!document.hidden) await look();
  setTimeout(poll, PERIOD);
}
recognise().catch(() => {}).finally(poll);
