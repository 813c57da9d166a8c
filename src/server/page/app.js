// The page: its views, the state line, the choice of model and source, and the form for the API key.

import { html, render, useEffect, useLayoutEffect, useMemo, useState } from "./preact.js";
import { go, link, note, read } from "./address.js";
import { unlock } from "./api.js";
import { Data } from "./data.js";
import { Dream } from "./dream.js";
import { Play } from "./play.js";
import { Robot } from "./robot.js";
import { follow, skillOf, takesActions, useLists } from "./server_lists.js";
import { sourcesOf } from "./sources.js";
import { Train } from "./train.js";
import { WhatIf } from "./what_if.js";

const VIEWS = [["play", "Play"], ["dream", "Dream"], ["what-if", "What if"], ["data", "Data"], ["train", "Train"]];
const WITH_ROBOT = { play: Play, dream: Dream, "what-if": WhatIf };

function useAddress() {
  const [address, setAddress] = useState(read());
  useEffect(() => {
    const changed = () => setAddress(read());
    addEventListener("hashchange", changed);
    addEventListener("noted", changed);
    return () => {
      removeEventListener("hashchange", changed);
      removeEventListener("noted", changed);
    };
  }, []);
  return address;
}

function App() {
  const lists = useLists();
  const { view: asked, parameters } = useAddress();
  const view = VIEWS.some(([name]) => name === asked) ? asked : "play";
  useEffect(() => { document.title = `${VIEWS.find(([name]) => name === view)[1]} – Foreframe`; }, [view]);
  useLayoutEffect(() => scrollTo(0, 0), [view, parameters.set]);
  return html`
    <a class="skip" href="#main" onClick=${event => { event.preventDefault(); document.getElementById("main").focus(); }}>Skip to the view</a>
    <header>
      <a class="brand" href="#play" aria-label="Foreframe"><${Mark} /> Foreframe</a>
      <nav aria-label="Views">${VIEWS.map(([name, words]) => html`
        <a href=${link(name, WITH_ROBOT[name] && WITH_ROBOT[view] ? { model: parameters.model, source: parameters.source, episode: parameters.episode } : {})}
          aria-current=${name === view ? "page" : undefined}>${words}</a>`)}</nav>
      <${StateLine} connection=${lists.connection} />
    </header>
    <main id="main" tabindex="-1">
      ${lists.connection === "locked" ? html`<${Unlock} why=${lists.locked} />`
        : view === "data" ? html`<${Data} lists=${lists} parameters=${parameters} />`
        : view === "train" ? html`<${Train} lists=${lists} parameters=${parameters} />`
        : html`<${WithRobot} view=${view} lists=${lists} parameters=${parameters} />`}
    </main>`;
}

const Mark = () => html`<svg viewBox="0 0 16 16" width="22" height="22" aria-hidden="true"><rect width="10" height="10" rx="2" class="one" /><rect x="6" y="6" width="10" height="10" rx="2" class="two" /></svg>`;

const CONNECTIONS = {
  connecting: ["care", "connecting"], connected: ["good", "connected"], reconnecting: ["bad", "reconnecting"],
  stopping: ["care", "server stopping"], locked: ["care", "locked"],
};
function StateLine({ connection }) {
  const [shade, words] = CONNECTIONS[connection];
  return html`<p class="state" role="status"><i class=${shade} />${words}</p>`;
}

function Unlock({ why }) {
  const [refused, setRefused] = useState(why);
  const submit = async event => {
    event.preventDefault();
    const wrong = await unlock(event.target.elements.key.value.trim());
    setRefused(wrong);
    if (!wrong) follow();
  };
  return html`<form class="unlock" onSubmit=${submit}>
    <h1>This server asks for an API key</h1>
    <label for="key">API key</label>
    <div><input id="key" name="key" type="password" autocomplete="off" spellcheck="false" required /><button class="main">Unlock</button></div>
    <p class="wrong" role="alert">${refused}</p>
    <p class="quiet">Create one with <code>foreframe keys create NAME</code>. This tab keeps it until it is closed.</p>
  </form>`;
}

// The best model that can be driven, else the best one that has a source.
function proposed(models, datasets) {
  const usable = models.filter(model => sourcesOf(model, datasets).length);
  return usable.find(takesActions) ?? usable[0];
}

function WithRobot({ view, lists: { models, datasets, notice }, parameters }) {
  const model = models && (models.find(({ name }) => name === parameters.model) ?? proposed(models, datasets));
  const sources = useMemo(() => (model ? sourcesOf(model, datasets) : []), [model, datasets]);
  const source = sources.find(({ id }) => id === parameters.source) ?? sources[0];
  const robot = useRobot(model, source?.id, parameters.episode);
  if (!models) return html`<p class="quiet wait">Loading…</p>`;
  if (!models.length) return html`<${NoModel} notice=${notice} />`;
  const View = WITH_ROBOT[view];
  return html`
    <div class="choice">
      <label>Model <select value=${model?.name ?? ""} onChange=${event => go(view, { model: event.target.value })}>
        ${!model && html`<option value="">choose one</option>`}
        ${models.map(one => html`<option value=${one.name}>${one.name}${skillOf(one) === undefined ? "" : `, skill ${skillOf(one).toFixed(2)}`}</option>`)}
      </select></label>
      <label>Source <select value=${source?.id ?? ""} disabled=${sources.length < 2} onChange=${event => note({ source: event.target.value, episode: "" })}>
        ${sources.map(({ id, label }) => html`<option value=${id}>${label}</option>`)}
        ${!sources.length && html`<option value="">none fits</option>`}
      </select></label>
    </div>
    ${parameters.model && parameters.model !== model?.name && html`<p class="wrong" role="alert">There is no model “${parameters.model}”.${model && ` “${model.name}” is shown instead.`}</p>`}
    ${robot ? html`<${View} robot=${robot} key=${robot} />` : !source && html`<${NoSource} model=${model} datasets=${datasets} />`}`;
}

function useRobot(model, source_id, episode) {
  const [robot, setRobot] = useState(null);
  const identity = model && source_id && `${model.name} ${model.active_version} ${source_id} ${episode}`;
  useEffect(() => {
    if (!identity) return setRobot(null);
    const made = new Robot(model, source_id, episode);
    setRobot(made);
    return () => made.close();
  }, [identity]);
  return robot?.is_closed ? null : robot;
}

function NoModel({ notice }) {
  return html`<div class="empty"><h1>No model is loaded</h1>
    <p>${notice}</p><p>Or <a href="#train">train one here</a>: collect a data set, then train on it.</p></div>`;
}

function NoSource({ model, datasets }) {
  if (!model) return html`<div class="empty"><h1>No source fits any model</h1><p>The models here were trained on recordings. <a href="#data">Import</a> a recording to see predictions for it.</p></div>`;
  if (!datasets) return html`<p class="quiet wait">Loading…</p>`;
  return html`<div class="empty"><h1>No source fits “${model.name}”</h1>
    <p>It takes frames of ${model.spec.frame_width_px}×${model.spec.frame_height_px} px every ${model.spec.frame_period_s} s,
    ${takesActions(model) ? ` with the actions ${model.spec.actions.map(({ name }) => name).join(" and ")}` : " without actions"}, as in “${model.lineage.dataset}”.
    A simulated room would only give it pictures that it does not know. <a href="#data">Import</a> a recording that fits.</p></div>`;
}

follow();
render(html`<${App} />`, document.getElementById("app"));
