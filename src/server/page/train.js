// Train: trainings, adaptations and evaluations, their curves and reports, and the models that come of them.

import { html, useEffect, useMemo, useRef, useState } from "./preact.js";
import { link, note } from "./address.js";
import { call, get } from "./api.js";
import { duration, isTraining, Log, Progress, Report, ServerPicture, Steer, titleOf, useJob } from "./job.js";
import { Models } from "./models.js";
import { COLORS, Plot } from "./plot.js";
import { levels } from "./score.js";
import { readModels } from "./server_lists.js";
import { Copy, curl, requests } from "./snippets.js";

export function Train({ lists, parameters }) {
  const { models, datasets, jobs, may_use_jobs } = lists;
  return html`<section>
    <h1>Train</h1>
    ${may_use_jobs ? html`<${Trainings} models=${models ?? []} datasets=${datasets} jobs=${jobs} parameters=${parameters} />`
      : html`<p class="quiet">This key may not use jobs; they need the scope <code>jobs</code>.</p>`}
    <h2>Models</h2>
    ${models ? html`<${Models} models=${models} datasets=${datasets} />` : html`<p class="quiet">Loading…</p>`}
  </section>`;
}

function Trainings({ models, datasets, jobs, parameters }) {
  const [wrong, setWrong] = useState("");
  const [submitted, setSubmitted] = useState(null);
  const submit = spec => call("POST", "/v1/jobs", spec).then(job => { note({ job: job.id }); setSubmitted(job.id); setWrong(""); }, error => setWrong(error.message));
  if (!datasets) return html`<p class="quiet wait">Loading…</p>`;
  const chosen = parameters.job ?? jobs.find(isTraining)?.id;
  return html`
    ${datasets.length ? html`<div class="forms"><${NewTraining} models=${models} datasets=${datasets} jobs=${jobs} submit=${submit} />${models.some(canBeAdapted) && html`<${NewAdaptation} models=${models.filter(canBeAdapted)} datasets=${datasets} submit=${submit} />`}<${NewEvaluation} models=${models} datasets=${datasets} submit=${submit} /></div>`
      : html`<div class="empty"><h2>First a data set</h2><p><a href="#data">Collect or import one</a>; then train on it here.</p></div>`}
    <p class="wrong" role="alert">${wrong}</p>
    ${jobs.length > 0 && html`<h2>Jobs</h2><${Jobs} jobs=${jobs} chosen=${chosen} />`}
    ${chosen && html`<${Watched} key=${chosen} id=${chosen} jobs=${jobs} models=${models} is_new=${chosen === submitted} />`}`;
}

// The presets, from the contract.
function usePresets() {
  const [presets, setPresets] = useState([]);
  useEffect(() => {
    get("/openapi.json").then(contract => setPresets(contract.components.schemas.TrainSpec.properties.preset.enum), () => {});
  }, []);
  return presets;
}

// The preset that was made for such data. Simulated data without a camera model has a camera for each room.
const proposedPreset = ({ scenario, camera }) => (!scenario ? "recording" : scenario === "static-observer" ? "static-flow" : camera ? "moving-flow" : "rooms");

// Lines KEY=VALUE as nested settings: sequence.batch_size=16 is { sequence: { batch_size: 16 } }.
function settingsOf(lines, steps) {
  const settings = {};
  let wrong = "";
  for (const line of [...lines.split("\n"), steps && `sequence.steps=${steps}`]) {
    const [key, value] = (line || "").split(/=(.*)/s).map(part => part.trim());
    if (!key && value === undefined) continue;
    if (!key || value === undefined) {
      wrong = `“${line.trim()}” is no setting: write name=value, for example sequence.batch_size=16.`;
      continue;
    }
    const parts = key.split("."), last = parts.pop();
    // A value that an earlier line gave to a group stays, and the server refuses it.
    const place = parts.reduce((within, part) => (within[part] = Object(within[part] ?? {})), settings);
    try {
      place[last] = JSON.parse(value);
    } catch {
      place[last] = value;
    }
  }
  return { settings, wrong };
}

// Steps and memory of a training, by the server, and why it would be refused; null until it is known.
function useEstimate(spec) {
  const [found, setFound] = useState({ needs: null, wrong: "" });
  const asked = JSON.stringify(spec);
  useEffect(() => {
    let is_old = false;
    // Not at every letter that is typed.
    const timer = setTimeout(() => call("POST", "/v1/jobs/estimate", spec).then(needs => { if (!is_old) setFound({ needs, wrong: "" }); }, error => { if (!is_old) setFound({ needs: null, wrong: error.message }); }), ESTIMATE_AFTER_MS);
    return () => {
      is_old = true;
      clearTimeout(timer);
    };
  }, [asked]);
  return found;
}

const memory = mib => (mib < 1024 ? `${mib} MiB` : `${(mib / 1024).toFixed(1)} GiB`);
const ESTIMATE_AFTER_MS = 300;

// Seconds for each step of finished trainings here with the same start, a preset or a model; null if there was none.
function secondsPerStep(jobs, start) {
  // One of a single attempt: between two, a job may rest.
  const done = jobs.find(({ spec, state, attempts }) => spec.kind === "train" && spec.preset === start.preset && spec.from === start.from && state === "succeeded" && attempts === 1);
  return done && done.progress.total ? (done.ended_unix_s - done.started_unix_s) / done.progress.total : null;
}

function NewTraining({ models, datasets, jobs, submit }) {
  const presets = usePresets();
  const [form, setForm] = useState({ dataset: datasets[0].name, from: "", preset: "", name: "", steps: "", settings: "" });
  const dataset = datasets.find(({ name }) => name === form.dataset) ?? datasets[0];
  const preset = form.preset || proposedPreset(dataset);
  const set = name => event => setForm({ ...form, [name]: event.target.value });
  // The preset for recordings takes actions; what is written below counts more.
  const implied = !form.from && preset === "recording" && !dataset.actions.length ? `model.conditioning=${dataset.states.length ? "state" : "none"}` : "";
  const { settings, wrong } = settingsOf(`${implied}\n${form.settings}`, form.steps);
  const start = form.from ? { from: form.from } : { preset };
  const spec = { kind: "train", name: form.name || dataset.name, ...start, dataset: dataset.name, ...(Object.keys(settings).length && { settings }) };
  const pace_s = secondsPerStep(jobs, start);
  const kind = form.from ? "from this model" : "of this preset";
  const { needs, wrong: refused } = useEstimate(spec);
  const time = !pace_s ? `Time: not known, since no training ${kind} has finished here yet; the job tells it after its first steps.`
    : needs ? `Time: about ${duration(pace_s * needs.steps)} for ${needs.steps} steps, from the last training ${kind} here.`
    : `Time: ${(1000 * pace_s).toFixed(0)} ms a step in the last training ${kind} here.`;
  const limit = needs?.memory_limit_mib ? ` of ${memory(needs.memory_limit_mib)} that a job may use` : "";
  const room = needs ? `Memory: at least ${memory(needs.memory_mib)}${limit}.` : "";
  const is_refused = needs?.memory_limit_mib > 0 && needs.memory_mib > needs.memory_limit_mib;
  return html`<form class="card" onSubmit=${event => { event.preventDefault(); if (!wrong) submit(spec); }}><h2>New training</h2><div class="form">
      <label>Data set <select value=${dataset.name} onChange=${set("dataset")}>${datasets.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select></label>
      <label>Start from <select value=${form.from} onChange=${set("from")}><option value="">new weights</option>${models.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select></label>
      ${!form.from && html`<label>Preset <select value=${preset} onChange=${set("preset")}>${(presets.length ? presets : [preset]).map(name => html`<option value=${name}>${name}</option>`)}</select></label>`}
      <label>Name of the model <input value=${form.name} placeholder=${dataset.name} pattern="[a-z0-9][a-z0-9\\-]*" onInput=${set("name")} /></label>
      <label>Steps <input type="number" min="1" value=${form.steps} placeholder=${`of the ${form.from ? "model" : "preset"}`} onInput=${set("steps")} /></label>
      <label class="wide">Other settings, one a line <textarea rows="2" value=${form.settings} placeholder="sequence.batch_size=16" onInput=${set("settings")} /></label>
    </div>${implied && html`<p class="quiet">This data set has no actions, so <code>${implied}</code> is set.</p>`}<p class="quiet estimate">${time} ${room}</p>${is_refused && html`<p class="wrong">It would be refused: use a smaller model or batch.</p>`}
    <p class="wrong" role="alert">${wrong || (refused && `It would be refused: ${refused}`)}</p>
    <div class="actions"><button class="main">Train</button><${Copy} curl=${() => curl("POST", "/v1/jobs", spec)} python=${() => requests("POST", "/v1/jobs", spec)} /></div></form>`;
}

// Whether a model sees how fast the camera drives, so that another robot can start from it. One that remembers a room is not offered.
const canBeAdapted = ({ spec }) => Boolean(spec.flow?.speeds && !spec.flow.memory);
const POSE = ["x", "y", "heading_cos", "heading_sin"];

function NewAdaptation({ models, datasets, submit }) {
  const [form, setForm] = useState({ mirror: [] });
  const dataset = datasets.find(({ name }) => name === form.dataset) ?? datasets.find(({ scenario }) => !scenario) ?? datasets[0];
  const from = form.from ?? models[0].name;
  const channels = [...new Set([...dataset.actions, ...dataset.states].map(({ name }) => name))];
  const canRemember = dataset.actions.length > 0 && POSE.every(channel => dataset.states.some(({ name }) => name === channel));
  const remember = canRemember && Boolean(form.remember);
  const mirror = channels.filter(name => !remember && form.mirror.includes(name));
  const spec = { kind: "adapt", name: form.name || `${dataset.name}-adapted`, dataset: dataset.name, from, ...(form.steps && { steps: +form.steps }), ...(mirror.length && { mirror }), ...(remember && { remember }) };
  const set = name => event => setForm({ ...form, [name]: event.target.value });
  const turn = name => () => setForm({ ...form, mirror: form.mirror.includes(name) ? form.mirror.filter(other => other !== name) : [...form.mirror, name] });
  return html`<form class="card" onSubmit=${event => { event.preventDefault(); submit(spec); }}><h2>New adaptation</h2><div class="form">
      <label>Data set <select value=${dataset.name} onChange=${set("dataset")}>${datasets.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select></label>
      <label>Start from <select value=${from} onChange=${set("from")}>${models.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select></label>
      <label>Name of the model <input value=${form.name} placeholder=${`${dataset.name}-adapted`} pattern="[a-z0-9][a-z0-9\\-]*" onInput=${set("name")} /></label>
      <label>Steps <input type="number" min="1" max="100000" value=${form.steps} placeholder="1200" onInput=${set("steps")} /></label>
      ${canRemember && html`<fieldset class="wide"><legend>Stays in one room</legend><label><input type="checkbox" checked=${remember} onChange=${() => setForm({ ...form, remember: !remember })} /> remember it, by poses that always count from the same origin</label></fieldset>`}
      ${channels.length > 0 && !remember && html`<fieldset class="wide"><legend>Changes its sign in a mirror</legend>${channels.map(name => html`<label><input type="checkbox" checked=${mirror.includes(name)} onChange=${turn(name)} /> ${name}</label>`)}</fieldset>`}
    </div><p class="quiet">For the recording of a robot that drives: estimates its camera, then trains the model further, about five minutes on two cores. A model that became no better is not published. Mark all actions and states that say left or right, such as a steering angle; then half of the windows are mirrored.</p>
    <div class="actions"><button class="main">Adapt</button><${Copy} curl=${() => curl("POST", "/v1/jobs", spec)} python=${() => requests("POST", "/v1/jobs", spec)} /></div></form>`;
}

function NewEvaluation({ models, datasets, submit }) {
  const [form, setForm] = useState({});
  const model = form.model ?? models[0]?.name;
  const dataset = form.dataset ?? datasets[0].name;
  const { versions = [], active_version } = models.find(({ name }) => name === model) ?? {};
  const version = versions.includes(+form.version) ? +form.version : active_version;
  const spec = { kind: "evaluate", model, ...(version !== active_version && { version }), dataset, ...(form.windows && { windows: +form.windows }) };
  const set = name => event => setForm({ ...form, [name]: event.target.value });
  const setModel = event => setForm({ ...form, model: event.target.value, version: undefined });
  return models.length > 0 && html`<form class="card" onSubmit=${event => { event.preventDefault(); submit(spec); }}><h2>New evaluation</h2><div class="form">
      <label>Model <select value=${model} onChange=${setModel}>${models.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select></label>
      ${versions.length > 1 && html`<label>Version <select value=${version} onChange=${set("version")}>${versions.map(one => html`<option value=${one}>${one}${one === active_version ? ", active" : ""}</option>`)}</select></label>`}
      <label>Data set <select value=${dataset} onChange=${set("dataset")}>${datasets.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select></label>
      <label>Windows of each test set <input type="number" min="1" max="100000" value=${form.windows} placeholder="2000" onInput=${set("windows")} /></label>
    </div><p class="quiet">Fewer windows are faster, with wider intervals. Compares the model with baselines on trials that training did not use, and writes a report.</p>
    <div class="actions"><button class="main">Evaluate</button><${Copy} curl=${() => curl("POST", "/v1/jobs", spec)} python=${() => requests("POST", "/v1/jobs", spec)} /></div></form>`;
}

const STATES = { running: "good", succeeded: "good", queued: "care", failed: "bad", cancelled: "quiet" };

// From the start of the first attempt to the end of the last one.
function timeOf({ started_unix_s, ended_unix_s, attempts }) {
  if (!started_unix_s) return "";
  return duration((ended_unix_s ?? Date.now() / 1000) - started_unix_s) + (attempts > 1 ? ` (${attempts} attempts, with pauses)` : "");
}

function Jobs({ jobs, chosen }) {
  return html`<div class="table jobs" tabindex="0" role="region" aria-label="jobs"><table><thead><tr><th scope="col">Job</th><th scope="col">Work</th><th scope="col">State</th><th scope="col">Time</th></tr></thead>
    <tbody>${jobs.map(job => html`<tr class=${job.id === chosen ? "chosen" : ""}><td><a href=${link("train", { job: job.id })} onClick=${event => { event.preventDefault(); note({ job: job.id }); }}>${job.id}</a></td>
      <td>${titleOf(job.spec)}</td><td class=${STATES[job.state]}>${job.state}</td><td>${timeOf(job)}</td></tr>`)}</tbody></table></div>`;
}

// The chosen job as it goes on. One that was submitted just now comes into sight.
function Watched({ id, jobs, models, is_new }) {
  const { job, lines, losses, wrong, again } = useJob(id);
  const panel = useRef();
  useEffect(() => {
    if (!is_new) return;
    panel.current.scrollIntoView();
    panel.current.focus({ preventScroll: true });
  }, [is_new]);
  return html`<div class="watched" ref=${panel} tabindex="-1">${wrong ? html`<p class="wrong" role="alert">${wrong}</p>`
    : !job ? html`<p class="quiet wait">Reading ${id}…</p>`
    : html`<${Panel} job=${job} lines=${lines} losses=${losses} jobs=${jobs} models=${models} onResume=${again} />`}</div>`;
}

function Panel({ job, lines, losses, jobs, models, onResume }) {
  const { id } = job;
  return html`
    <h2>${id}: ${titleOf(job.spec)} <span class=${STATES[job.state]}>${job.state}</span></h2>
    <${Progress} job=${job} />
    ${job.result?.version && isTraining(job) && html`<${Published} result=${job.result} models=${models} />`}
    <div class="actions"><${Steer} job=${job} onResume=${onResume} />
      ${job.state === "succeeded" && ["collect", "import"].includes(job.spec.kind) && html`<a href=${link("data", { set: job.spec.name })}>open it</a>`}</div>
    ${isTraining(job) && html`<${Curves} job=${job} losses=${losses} jobs=${jobs} /><${Sample} id=${id} losses=${losses} />`}
    <${Report} job=${job} />
    <details><summary>Log</summary><${Log} lines=${lines} /></details>
    <footer><${Copy} curl=${() => curl("GET", `/v1/jobs/${id}/events`, undefined, " -N")} python=${() => requests("GET", `/v1/jobs/${id}`)} /></footer>`;
}

// The version that a training published, and what an adaptation gained.
function Published({ result: { model: name, version, metrics }, models }) {
  const [wrong, setWrong] = useState("");
  const model = models.find(one => one.name === name);
  const has_version = model?.versions.includes(version);
  const activate = () => call("POST", `/v1/models/${name}/versions/${version}/activate`).then(() => { setWrong(""); return readModels(); }).catch(error => setWrong(error.message));
  const is_coming = !model || version > Math.max(...model.versions);
  const state = is_coming ? "it is not loaded yet." : !has_version ? "it was deleted."
    : model.active_version === version ? html`it is active. <a href=${link("play", { model: name })}>play it</a>`
    : html`version ${model.active_version} is active and is the one that plays. <button class="small" onClick=${activate}>Activate version ${version}</button>`;
  return html`<p>Published as version ${version} of ${name}; ${state}</p><p class="wrong" role="alert">${wrong}</p>
    ${metrics?.adaptation && html`<${Gain} ...${metrics.adaptation} />`}`;
}

const Gain = ({ before, after, copied, windows }) => html`<p>Error on ${windows} validation windows: <b>${levels(after).toFixed(1)}</b> gray levels,
  before the adaptation ${levels(before).toFixed(1)}; a copy of the last frame ${levels(copied).toFixed(1)}.</p>`;

// What the network predicts at its latest validation.
function Sample({ id, losses }) {
  const step = losses.findLast(point => point.stage === "sequence" && point.validation !== null)?.step;
  return step !== undefined && html`<figure class="sample"><figcaption>A validation window at step ${step}: above the true frames, below the predicted ones</figcaption>
    <${ServerPicture} path=${`/v1/jobs/${id}/sample.png?step=${step}`} alt="true frames above predicted frames" /></figure>`;
}

// The losses of a stage as a line: places and values.
const lineOf = (points, stage, name) => points.filter(point => point.stage === stage && point[name] !== null).map(point => [point.step, point[name]]);

// Lines with different places as one table.
function joined(lines) {
  const places = [...new Set(lines.flatMap(line => line.map(([step]) => step)))].sort((one, other) => one - other);
  return [places, ...lines.map(line => {
    const values = new Map(line);
    return places.map(step => values.get(step) ?? null);
  })];
}

// The curves of a training on a log scale, and those of others over them.
function Curves({ job: { id, state }, losses, jobs }) {
  const [others, setOthers] = useState({});
  const trainings = jobs.filter(job => isTraining(job) && job.id !== id).slice(0, 8);
  const toggle = async other => {
    const { [other]: known, ...rest } = others;
    if (known) return setOthers(rest);
    const { points } = await get(`/v1/jobs/${other}/metrics`);
    return setOthers({ ...rest, [other]: points });
  };
  // Null before the first loss.
  const stage = losses.at(-1)?.stage ?? null;
  const overlaid = Object.keys(others);
  const data = useMemo(() => joined([lineOf(losses, stage, "train"), lineOf(losses, stage, "validation"), ...overlaid.map(other => lineOf(others[other], stage, "validation"))]), [losses, others, stage]);
  const series = [{ label: "training", color: "--quiet", width: 1 }, { label: "validation", color: "--orange", width: 2, points: true },
    ...overlaid.map((other, place) => ({ label: `validation of ${other}`, color: COLORS[(place + 3) % COLORS.length], width: 2 }))];
  const none = { queued: "No loss yet: the job waits for its turn.", running: "No loss yet; the first comes after some steps." };
  return html`<h3>Loss${stage ? `, stage ${stage}` : ""}</h3>
    ${losses.length ? html`<${Plot} label="loss of the training and the validation windows" data=${data} series=${series} height=${240} x="step" log legend />` : html`<p class="quiet">${none[state] ?? "No loss was measured."}</p>`}
    ${trainings.length > 0 && html`<div class="actions" role="group" aria-label="runs over this one">${trainings.map(job => html`<button class="small" aria-pressed=${Boolean(others[job.id])} onClick=${() => toggle(job.id)}>${job.id}, ${job.spec.name}</button>`)}</div>`}`;
}
