// Data: the data sets as cards, and one of them with its episodes and its inspection.

import { html, useState } from "./preact.js";
import { go, link, note } from "./address.js";
import { call } from "./api.js";
import { Episode, Moving } from "./episode.js";
import { filled, Import } from "./import_form.js";
import { Embedded, isFinal, Progress, Steer, titleOf, useJob } from "./job.js";
import { Copy, curl, requests } from "./snippets.js";

export function Data({ lists, parameters }) {
  if (!lists.may_use_jobs) return html`<div class="empty"><h1>This key may not see the data sets</h1><p>It is a key for predictions. Data sets need a key with the scope <code>jobs</code>.</p></div>`;
  if (!lists.datasets) return html`<p class="quiet wait">Loading…</p>`;
  const dataset = lists.datasets.find(({ name }) => name === parameters.set);
  return dataset ? html`<${DataSet} dataset=${dataset} models=${lists.models ?? []} parameters=${parameters} />`
    : html`<${Overview} datasets=${lists.datasets} jobs=${lists.jobs} missing=${parameters.set} />`;
}

function Overview({ datasets, jobs, missing }) {
  return html`<section>
    <h1>Data sets</h1>
    ${missing && html`<p class="wrong">There is no data set “${missing}”.</p>`}
    ${!datasets.length && html`<div class="empty"><h2>None yet</h2><p>Collect one from the simulator, or drop a recording into the form below. It appears here when the job is done.</p></div>`}
    <div class="cards">${datasets.map(dataset => html`<a class="card" key=${dataset.name} href=${link("data", { set: dataset.name })}>
      <${Moving} dataset=${dataset} /><h2>${dataset.name}</h2><${Facts} dataset=${dataset} /></a>`)}</div>
    <${NewData} jobs=${jobs} />
    <footer><${Copy} curl=${() => curl("GET", "/v1/datasets")} python=${() => requests("GET", "/v1/datasets")} /></footer>
  </section>`;
}

const channels = list => list.map(({ name }) => name).join(", ") || "none";
function Facts({ dataset }) {
  const length_s = dataset.frames * dataset.frame_period_s;
  const facts = [["episodes", dataset.episodes], ["frames", dataset.frames.toLocaleString("en")], ["length", length_s < 120 ? `${length_s.toFixed(0)} s` : `${(length_s / 60).toFixed(0)} min`],
    ["size", `${dataset.frame_width_px}×${dataset.frame_height_px} px`], ["actions", channels(dataset.actions)], ["source", dataset.scenario ? `simulator, ${dataset.scenario}` : "recorded"]];
  return html`<dl class="facts">${facts.map(([name, value]) => html`<dt>${name}</dt><dd>${value}</dd>`)}</dl>`;
}

function DataSet({ dataset, models, parameters }) {
  const number = Math.max(0, Math.min(dataset.episodes - 1, +(parameters.episode ?? 0) || 0));
  const [shows, setShows] = useState(false);
  const move = to => note({ episode: to, frame: 0 });
  return html`<section>
    <p><a href="#data">‹ all data sets</a></p>
    <h1>${dataset.name}</h1>
    <div class="choice"><label>Episode <input type="number" min="0" max=${dataset.episodes - 1} value=${number} onChange=${event => move(event.target.value)} /></label>
      <span class="of">(0 to ${dataset.episodes - 1})</span><button class="small" disabled=${number === 0} onClick=${() => move(number - 1)}>previous</button>
      <button class="small" disabled=${number >= dataset.episodes - 1} onClick=${() => move(number + 1)}>next</button></div>
    <${Episode} key=${`${dataset.name} ${number}`} dataset=${dataset} number=${number} models=${models} parameters=${parameters} />
    <details onToggle=${event => setShows(event.target.open)}><summary>Inspection: what to look at before training</summary>
      ${shows && html`<${Embedded} path=${`/v1/datasets/${dataset.name}/inspection`} label="inspection" />`}</details>
    <${Delete} name=${dataset.name} />
  </section>`;
}

function Delete({ name }) {
  const [wrong, setWrong] = useState("");
  const remove = () => call("DELETE", `/v1/datasets/${name}`).then(() => go("data"), error => setWrong(error.message));
  return html`<div class="actions"><button class="small" onClick=${() => confirm(`Delete the data set ${name}? It cannot be undone.`) && remove()}>Delete this data set</button></div>
    <p class="wrong" role="alert">${wrong}</p>`;
}

const SCENARIOS = ["moving-observer", "static-observer", "crowded", "crossing"];

const NewData = ({ jobs }) => html`<h2>New data set</h2>
  <div class="forms"><${Collect} /><${Import} jobs=${jobs} /></div>
  <${Making} jobs=${jobs} />`;

// The jobs that had ended when this view was opened first.
let old = null;
// Of those that end later, so many are shown.
const MOST_ENDED = 3;
// A browser has few connections for one server, and each followed job takes one.
const MOST_FOLLOWED = 2;

// The jobs that make data sets, whoever submitted them.
function Making({ jobs }) {
  const makers = jobs.filter(({ spec }) => ["collect", "import"].includes(spec.kind));
  const open = makers.filter(job => !isFinal(job));
  old ??= new Set(makers.filter(isFinal).map(({ id }) => id));
  for (const { id } of open) old.delete(id);
  const ended = makers.filter(job => isFinal(job) && !old.has(job.id)).slice(0, MOST_ENDED);
  const followed = [...open.filter(({ state }) => state === "running").slice(0, MOST_FOLLOWED), ...ended];
  return [...open, ...ended].map(job => html`<${Follow} key=${job.id} listed=${job} is_followed=${followed.includes(job)} />`);
}

// Of the notes of a job, so many are shown.
const MOST_NOTES = 5;

function Follow({ listed, is_followed }) {
  const { job: followed, lines, again } = useJob(is_followed ? listed.id : null);
  const job = followed ?? listed;
  const notes = lines.map(({ line }) => line).filter(isNote);
  const more = notes.length - MOST_NOTES;
  return html`<div class="card making"><h3>${titleOf(job.spec)}</h3><${Progress} job=${job} />
    ${notes.slice(0, MOST_NOTES).map(line => html`<p class="care">${line}</p>`)}
    ${more > 0 && html`<p class="care">and ${more} more; the job's log in Train has all</p>`}
    <div class="actions"><${Steer} job=${job} onResume=${again} />
    ${job.state === "succeeded" && html`<a href=${link("data", { set: job.spec.name })}>open it</a>`}</div></div>`;
}

// Lines that tell more than the job's state.
const isNote = line => !/^(started|succeeded|cancelled|failed: |attempt )/.test(line);

function Collect() {
  const [wrong, setWrong] = useState("");
  const onSubmit = event => {
    event.preventDefault();
    const { name, scenario, rooms, trials, seed } = filled(event.target);
    const spec = { kind: "collect", name, scenario, ...(rooms && { rooms }), trials: +trials, seed: +seed };
    call("POST", "/v1/jobs", spec).then(() => setWrong(""), error => setWrong(error.message));
  };
  return html`<form class="card" onSubmit=${onSubmit}><h3>Collect from the simulator</h3><div class="form">
    <label>Name <input name="name" required pattern="[a-z0-9][a-z0-9\\-]*" placeholder="first" /></label>
    <label>Scenario <select name="scenario">${SCENARIOS.map(one => html`<option value=${one}>${one}</option>`)}</select></label>
    <label>Rooms <select name="rooms"><option value="">one</option><option value="varied">varied, one a trial</option></select></label>
    <label>Trials <input name="trials" type="number" min="1" max="1000000" value="50" /></label>
    <label>Seed <input name="seed" type="number" min="0" value="1" /></label>
    </div><div class="actions"><button class="main">Collect</button></div>
    <p class="wrong" role="alert">${wrong}</p></form>`;
}
