"use strict";
// A simulated robot runs on the server. This page drives it, streams its frames to a model, and shows the predicted frames
// beside the actual ones.

const by_id = id => document.getElementById(id);
const as_png = frame => `data:image/png;base64,${frame}`;
const pause = ms => new Promise(done => setTimeout(done, ms));

// The tab keeps the API key and sends it in headers, never in a URL.
let key = sessionStorage.getItem("key");
class Locked extends Error {}

async function call(method, path, body) {
  const shown = key;
  const headers = { ...(body !== undefined && { "Content-Type": "application/json" }), ...(shown && { Authorization: `Bearer ${shown}` }) };
  const response = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  const answer = response.status === 204 ? null : await response.json();
  if (response.status === 401) {
    if (shown === key) lock(shown ? "This key is unknown or was revoked." : "");
    throw new Locked(answer.detail);
  }
  if (!response.ok) throw new Error(answer.detail);
  return answer;
}

function lock(why) {
  run++; // Ends the trial.
  key = null;
  sessionStorage.removeItem("key");
  if (why || by_id("unlock").hidden) by_id("refused").textContent = why;
  by_id("unlock").hidden = false;
  document.querySelector("main").hidden = true;
}
by_id("unlock").addEventListener("submit", async event => {
  event.preventDefault();
  const given = by_id("key").value.trim();
  // Do not send a text that cannot be a key.
  if (!/^ffk_[0-9a-f]+_[\w-]+$/.test(given)) return lock("This is not a key. A key looks like ffk_0123456789ab_… and is shown once, when it is created.");
  key = given;
  try {
    await call("GET", "/v1/models");
  } catch (error) {
    if (!(error instanceof Locked)) by_id("refused").textContent = error.message;
    return;
  }
  sessionStorage.setItem("key", key);
  by_id("key").value = "";
  by_id("unlock").hidden = true;
  by_id("bearer").hidden = false;
  document.querySelector("main").hidden = false;
  by_id("model").replaceChildren();
  models = [];
  refresh();
});

// The command of the pressed keys, in m/s and rad/s.
const held = new Set();
const KEYS = { w: "w", arrowup: "w", a: "a", arrowleft: "a", s: "s", arrowdown: "s", d: "d", arrowright: "d" };
const [SPEED_M_S, TURN_RAD_S] = [0.35, 0.9];
function command() {
  const pull = (plus, minus) => held.has(plus) - held.has(minus);
  return held.size ? [SPEED_M_S * pull("w", "s"), TURN_RAD_S * pull("a", "d")] : null;
}
function hold(name, down) {
  down ? held.add(name) : held.delete(name);
  for (const button of document.querySelectorAll("#pad button")) button.classList.toggle("down", held.has(button.dataset.key));
}
function on_key(event, down) {
  const name = KEYS[event.key.toLowerCase()];
  if (!name || event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
  event.preventDefault();
  hold(name, down);
}
addEventListener("keydown", event => on_key(event, true));
addEventListener("keyup", event => on_key(event, false));
addEventListener("blur", () => [...held].forEach(name => hold(name, false)));
for (const button of document.querySelectorAll("#pad button")) {
  button.addEventListener("pointerdown", () => hold(button.dataset.key, true));
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) button.addEventListener(end, () => hold(button.dataset.key, false));
}

// A stream of one model. `send` resolves to the answer to that frame.
class Stream {
  static open(model) {
    return new Promise((opened, failed) => {
      const address = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/v1/models/${model}/stream`;
      // A browser cannot set headers of a WebSocket, so the key is sent as a sub-protocol.
      const stream = new Stream(new WebSocket(address, ["foreframe.v1.json", ...(key ? [`foreframe.key.${key}`] : [])]));
      stream.waiting = { resolve: ready => opened(Object.assign(stream, { ready })), reject: failed };
    });
  }
  constructor(socket) {
    this.socket = socket;
    this.seq = 0;
    const end = reason => this.waiting?.reject(new Error(reason));
    socket.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      if (message.type === "error") return end(message.detail);
      if (message.type === "closing") return end(`the stream was closed: ${message.reason}`);
      this.waiting?.resolve(message);
    };
    socket.onclose = () => end("the stream is closed");
  }
  send(image, action, state) {
    return new Promise((resolve, reject) => {
      this.waiting = { resolve, reject };
      const timestamp_us = Math.round(performance.now() * 1000);
      this.socket.send(JSON.stringify({ type: "frame", seq: this.seq++, timestamp_us, image, format: "png", action, state }));
    });
  }
  close() {
    this.waiting = null;
    this.socket.close();
  }
}

// Gray values 0…1 of a PNG.
async function pixels(frame) {
  const image = new Image();
  image.src = as_png(frame);
  await image.decode();
  const canvas = new OffscreenCanvas(image.width, image.height), context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, image.width, image.height).data.filter((_, index) => index % 4 === 0);
}
const mse = (one, other) => one.reduce((sum, value, i) => sum + ((value - other[i]) / 255) ** 2, 0) / one.length;

// Prepares the table: one column for each predicted step.
function lay_out({ horizon, frame_width_px, frame_height_px }) {
  by_id("drive").style.setProperty("--horizon", horizon);
  by_id("drive").style.setProperty("--aspect", frame_width_px / frame_height_px);
  const head = document.querySelector("#film thead tr");
  for (const row of [head, ...document.querySelectorAll("#film tbody tr")]) while (row.cells.length > 1) row.deleteCell(1);
  for (let step = 1; step <= horizon; step++) {
    head.insertCell().textContent = `t+${step}`;
    for (const row of ["next", "predicted", "actual"]) by_id(row).insertCell().append(new Image());
    by_id("error").insertCell();
  }
}
function show(row, frames) {
  document.querySelectorAll(`#${row} img`).forEach((image, step) => {
    if (frames[step]) image.src = as_png(frames[step]); else image.removeAttribute("src");
  });
}

// Runs trials until the user selects another model or leaves the page.
let run = 0;
async function drive(model) {
  const mine = ++run;
  const { context, horizon, frame_period_s, frame_width_px, frame_height_px, conditioning, actions, states } = model.spec;
  const [takes_actions, takes_state] = [conditioning.endsWith("action"), conditioning.startsWith("state")];
  const scenario = model.lineage.scenario ?? (takes_actions ? "moving-observer" : "static-observer");
  const world = { frame_period_s, frame_width_px, frame_height_px, max_duration_s: scenario === "static-observer" ? 30 : 3600 };
  lay_out(model.spec);
  by_id("predicted").cells[0].textContent = `predicted ${(horizon * frame_period_s).toFixed(1)}\u00a0s ago`;
  by_id("keys").hidden = scenario === "static-observer";
  const seed = Math.floor(Math.random() * 2 ** 32);
  const environment = await call("POST", "/v1/environments", { scenario, seed, world });
  const path = `/v1/environments/${environment.id}`;
  // A closed or reloaded page deletes its environment; the request outlives the page.
  const leave = () => fetch(path, { method: "DELETE", keepalive: true, headers: key ? { Authorization: `Bearer ${key}` } : {} });
  addEventListener("pagehide", leave);
  let stream = null;
  try {
    let { observation, info } = environment;
    while (mine === run) {
      stream = await Stream.open(model.name);
      const past = []; // Frames with their predictions, the latest last.
      for (let ended = false; !ended && mine === run;) {
        const started = performance.now();
        const action = command() ?? info.policy_action;
        const answer = await stream.send(observation.frame, takes_actions ? action : undefined, takes_state ? observation.state : undefined);
        const round_trip_ms = performance.now() - started;
        past.push({ frame: observation.frame, predicted: answer.frames });
        if (past.length > horizon + 1) past.shift();
        by_id("now").src = as_png(observation.frame);
        show("next", answer.frames ?? []);
        const origin = past[0];
        if (past.length > horizon && origin.predicted) {
          show("predicted", origin.predicted);
          show("actual", past.slice(1).map(moment => moment.frame));
          compare(origin, past.slice(1).map(moment => moment.frame));
        }
        const speed = action.map(value => value.toFixed(2));
        by_id("status").textContent = (answer.type === "buffering" ? `${answer.have} of ${context} frames received` :
          `answered in ${round_trip_ms.toFixed(1)} ms, ${(answer.timing.compute_us / 1000).toFixed(1)} ms of it the model`) +
          (takes_actions ? `; ${held.size ? "your keys" : "automatic driver"}: ${speed[0]} m/s, ${speed[1]} rad/s` : "");
        const step = await call("POST", `${path}/step`, { action });
        ({ observation, info } = step);
        ended = step.terminated || step.truncated;
        await pause(Math.max(0, frame_period_s * 1000 - (performance.now() - started)));
      }
      stream.close();
      if (mine === run) ({ observation, info } = await call("POST", `${path}/reset`, {}));
    }
  } finally {
    removeEventListener("pagehide", leave);
    stream?.close();
    await call("DELETE", path).catch(() => null); // It may already be deleted.
  }
}

async function compare(origin, came) {
  const [last, predicted, truth] = [await pixels(origin.frame), await Promise.all(origin.predicted.map(pixels)), await Promise.all(came.map(pixels))];
  truth.forEach((frame, step) => {
    const cell = by_id("error").cells[step + 1];
    if (!cell || !predicted[step]) return;
    const share = 100 * mse(predicted[step], frame) / mse(last, frame);
    cell.textContent = Number.isFinite(share) ? `${share < 999 ? share.toFixed(0) : ">999"} %` : "–";
  });
}

async function start() {
  const model = models.find(({ name }) => name === by_id("model").value);
  if (!model) return;
  const mine = run + 1;
  try {
    await drive(model);
  } catch (error) {
    if (mine !== run) return;
    by_id("status").textContent = `${error.message}. Trying again…`;
    await pause(2000);
    if (mine === run) start();
  }
}
by_id("model").addEventListener("change", () => { by_id("model").blur(); start(); });
by_id("again").addEventListener("click", () => { by_id("again").blur(); start(); });

// Fills a table.
function fill(id, rows, empty) {
  const body = by_id(id);
  const labels = [...body.parentElement.tHead.rows[0].cells].map(cell => cell.textContent);
  body.replaceChildren();
  if (!rows.length) {
    const cell = body.insertRow().insertCell();
    Object.assign(cell, { colSpan: labels.length, className: "quiet", textContent: empty });
  }
  for (const parts of rows) {
    const row = body.insertRow();
    parts.forEach((part, column) => {
      const cell = row.insertCell();
      cell.dataset.label = labels[column];
      cell.append(part);
    });
  }
}
function element(name, properties, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}
function progress(job) {
  if (job.error) return element("span", { className: "wrong" }, job.error);
  const { done, total, remaining_s, message } = job.progress;
  const is_running = job.state === "running";
  const words = [total ? `${done} of ${total}` : "", is_running ? message : "",
    is_running && remaining_s != null ? `${Math.ceil(remaining_s)} s left` : "",
    job.losses?.train == null ? "" : `loss ${job.losses.train.toPrecision(3)}`];
  // A progress bar without a value means that the total is unknown.
  const bar = element("progress", total ? { max: total, value: done } : is_running ? {} : { max: 1, value: 0 });
  return element("span", {}, bar, element("span", { className: "quiet" }, words.filter(Boolean).join(", ")));
}
const task = ({ kind, name, model, dataset }) => `${kind} ${name ?? model}${dataset ? ` on ${dataset}` : ""}`;
function skill({ metrics }) {
  const value = metrics.test?.skill;
  return value === undefined ? "not measured" : value.toFixed(2);
}
let models = [];
let next_refresh;
async function refresh() {
  clearTimeout(next_refresh);
  try {
    const names = models.map(({ name }) => name).join();
    ({ models } = await call("GET", "/v1/models"));
    fill("models", models.map(model => [
      `${model.name} v${model.active_version}`,
      `${model.spec.frame_width_px}×${model.spec.frame_height_px} px every ${model.spec.frame_period_s} s`,
      `${model.spec.context} → ${model.spec.horizon}`,
      { none: "none", action: "actions", state: "state", "state-action": "state and actions" }[model.spec.conditioning],
      skill(model),
    ]), "no model is loaded");
    if (names !== models.map(({ name }) => name).join()) {
      const chosen = by_id("model").value;
      by_id("model").replaceChildren(...models.map(({ name }) => new Option(name)));
      const first = models.find(({ name }) => name === chosen) ?? models.find(({ name }) => name === "static") ?? models[0];
      if (first) by_id("model").value = first.name;
      if (!chosen) start();
    }
    if (!models.length) by_id("status").textContent = "No model is loaded. Put a model into the server's models directory, publish one with foreframe publish, or start a training job.";
    const { jobs } = await call("GET", "/v1/jobs?limit=20");
    fill("jobs", jobs.map(job => [job.id, task(job.spec), job.state, progress(job)]), "none");
  } catch (error) {
    if (error instanceof Locked) return; // Wait for a key.
    // The server does not answer. Try again at the next refresh.
  }
  next_refresh = setTimeout(refresh, 1000);
}
by_id("origin").textContent = location.origin;
by_id("bearer").hidden = !key;
refresh();
