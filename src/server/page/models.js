// The models as cards, the most skilled first; with their versions.

import { html, useState } from "./preact.js";
import { link } from "./address.js";
import { call } from "./api.js";
import { readModels } from "./server_lists.js";
import { fits } from "./sources.js";

export function Models({ models, datasets }) {
  const [wrong, setWrong] = useState("");
  const [pair, setPair] = useState([]);
  const act = (method, path) => call(method, path).then(() => { setWrong(""); return readModels(); }, error => setWrong(error.message));
  const mark = name => setPair(now => (now.includes(name) ? now.filter(one => one !== name) : [...now, name].slice(-2)));
  if (!models.length) return html`<p class="quiet">None yet: the first training publishes one.</p>`;
  return html`<div>
    <${Compare} pair=${models.filter(({ name }) => pair.includes(name))} datasets=${datasets} />
    <p class="wrong" role="alert">${wrong}</p>
    <div class="cards">${models.map(model => html`<${Card} key=${model.name} model=${model} act=${act} is_marked=${pair.includes(model.name)} mark=${() => mark(model.name)} />`)}</div>
  </div>`;
}

// One episode that both take, with both predictions.
function Compare({ pair, datasets }) {
  if (pair.length < 2) return html`<p class="quiet">Mark two models to compare them on one episode.</p>`;
  const [one, other] = pair;
  const shared = (datasets ?? []).find(dataset => fits(one, dataset) && fits(other, dataset));
  return shared ? html`<p><a href=${link("data", { set: shared.name, episode: 0, model: one.name, other: other.name })}>Compare ${one.name} and ${other.name} on ${shared.name}</a></p>`
    : html`<p class="quiet">No data set here fits both ${one.name} and ${other.name}. Collect one with their scenario.</p>`;
}

const INPUTS = { none: "images only", action: "actions", state: "state", "state-action": "state and actions" };

function Card({ model, act, is_marked, mark }) {
  const { name, spec, metrics, lineage, versions, active_version } = model;
  const { skill, skill_interval_95: interval, strongest_baseline } = metrics.test ?? {};
  const facts = [["inputs", INPUTS[spec.conditioning]], ["frames", `${spec.frame_width_px}×${spec.frame_height_px} px, ${spec.frame_period_s} s`],
    ["predicts", `${spec.horizon} frames from ${spec.context}`], ["parameters", lineage.parameters.toLocaleString("en")], ["trained on", lineage.dataset]];
  return html`<article class=${`card ${is_marked ? "chosen" : ""}`}>
    <h3>${name}</h3>
    <${Skill} skill=${skill} interval=${interval} baseline=${strongest_baseline} />
    <dl class="facts">${facts.map(([what, value]) => html`<dt>${what}</dt><dd>${value}</dd>`)}</dl>
    <div class="actions"><a class="small" href=${link("play", { model: name })}>play</a>
      <button class="small" aria-pressed=${is_marked} onClick=${mark}>compare</button></div>
    ${versions.length > 1 && html`<ul class="versions">${versions.map(version => html`<li>version ${version} ${version === active_version ? html`<b class="good">active</b>` : html`
      <button class="small" onClick=${() => act("POST", `/v1/models/${name}/versions/${version}/activate`)}>Activate</button>
      <button class="small" onClick=${() => confirm(`Delete version ${version} of ${name}?`) && act("DELETE", `/v1/models/${name}/versions/${version}`)}>Delete</button>`}</li>`)}</ul>`}
  </article>`;
}

// 0 is as good as the strongest baseline, 1 is perfect.
function Skill({ skill, interval, baseline }) {
  if (skill === undefined) return html`<p class="quiet">skill not measured; evaluate it on a data set</p>`;
  const place = value => Math.max(0, Math.min(100, 100 * value));
  const words = `skill ${skill.toFixed(2)}${interval ? `, 95 % interval ${interval.map(value => value.toFixed(2)).join(" to ")}` : ""}`;
  return html`<p title=${`1 − error / error of the strongest baseline${baseline ? ` (${baseline})` : ""}, on test data`}>${words}</p>
    <div class="bar" role="img" aria-label=${words}><span class=${skill > 0 ? "good" : "bad"} style=${{ width: `${place(skill)}%` }} />
    ${interval && html`<em style=${{ left: `${place(interval[0])}%`, width: `${place(interval[1]) - place(interval[0])}%` }} />`}</div>`;
}
