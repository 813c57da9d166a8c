// An episode: a player with plots of actions and states, and how well models predict it.

import { html, useEffect, useMemo, useRef, useState } from "./preact.js";
import { go, note } from "./address.js";
import { cameraOf } from "./camera.js";
import { Picture } from "./picture.js";
import { COLORS, Plot } from "./plot.js";
import { bestGuess, compare, GUESSES, guessError, levels, lookBack } from "./score.js";
import { Copy, curl, requests } from "./snippets.js";
import { useRetry } from "./server_lists.js";
import { fits, readEpisode } from "./sources.js";
import { Stream } from "./stream.js";

// As many frames are read; a longer episode says so.
const MOST_FRAMES = 1500;
const SPEEDS = [0.25, 0.5, 1, 2, 4];

async function readAll(dataset, episode) {
  const all = await readEpisode(dataset, episode);
  while (all.frames.length < Math.min(all.frame_count, MOST_FRAMES)) {
    const more = await readEpisode(dataset, episode, all.frames.length);
    for (const name of ["frames", "actions", "states", "times_s"]) all[name].push(...more[name]);
  }
  return all;
}

function useEpisode(dataset, episode) {
  const [read, setRead] = useState({ data: null, wrong: "" });
  const retry = useRetry(Boolean(read.wrong));
  useEffect(() => {
    let is_gone = false;
    readAll(dataset, episode).then(data => is_gone || setRead({ data, wrong: "" }), error => is_gone || setRead({ data: null, wrong: error.message }));
    return () => { is_gone = true; };
  }, [dataset, episode, retry]);
  return read;
}

const TOLD_EVERY = 20;

// What a model predicts for every frame of an episode, and how wrong that is; filled while its stream answers.
function usePredictions(model, data) {
  const [moments, setMoments] = useState([]);
  const [wrong, setWrong] = useState("");
  const retry = useRetry(Boolean(wrong));
  useEffect(() => {
    setMoments([]);
    setWrong("");
    if (!model || !data) return undefined;
    let is_gone = false;
    predictAll(model, data, done => is_gone || setMoments(done), () => is_gone).catch(error => is_gone || setWrong(error.message));
    return () => { is_gone = true; };
  }, [model?.name, model?.active_version, data, retry]);
  return { moments, wrong };
}

async function predictAll(model, { frames, actions, states, camera }, tell, isGone) {
  const { spec } = model;
  const stream = await Stream.open(model, camera);
  const history = [];
  try {
    let answers = [];
    for (const [place, frame] of frames.entries()) {
      if (isGone()) return;
      const plan = actions.slice(place, place + spec.horizon);
      const moment = { frame, action: actions[place], state: states[place], begins: place === 0 };
      answers = [...answers, await stream.send({ ...moment, plan: plan.length === spec.horizon ? plan : undefined })].slice(-spec.horizon - 1);
      history.push(moment);
      const past = lookBack(history, spec);
      if (past && answers[0].type === "prediction") Object.assign(moment, compare(moment, past, answers[0], spec, camera ?? cameraOf(model)));
      if (place % TOLD_EVERY === 0) tell([...history]);
    }
    tell([...history]);
  } finally {
    stream.close();
  }
}

export function Episode({ dataset, number, models, parameters }) {
  const { data, wrong } = useEpisode(dataset.name, number);
  const fitting = models.filter(model => fits(model, dataset));
  // The best one, unless another or none was chosen.
  const model = parameters.model === undefined ? fitting[0] : fitting.find(({ name }) => name === parameters.model);
  const other = fitting.find(({ name }) => name === parameters.other);
  const predicted = [usePredictions(model, data), usePredictions(other, data)];
  const [first, second] = predicted.map(({ moments }) => moments);
  const player = usePlayer(data, dataset.frame_period_s, +parameters.frame || 0);
  if (wrong) return html`<p class="wrong" role="alert">${wrong}</p>`;
  if (!data) return html`<p class="quiet wait">Reading the episode…</p>`;
  const { at } = player;
  const frame = data.frames[at];
  const path = `/v1/datasets/${dataset.name}/episodes/${number}`;
  return html`<div>
    <div class="player">
      <div>
        <div class=${model ? "three" : ""}>
          <${Picture} image=${frame} caption="recorded" label=${`frame ${at}`} />
          ${[[model, first], [other, second]].map(([one, moments]) => one && html`<${Picture} image=${moments[at]?.predicted ?? frame} dim=${!moments[at]?.predicted}
            note=${moments[at]?.predicted ? "" : moments.length <= at ? "predicting" : "no prediction yet"} caption=${`predicted by ${one.name}`} label=${`what ${one.name} predicted for frame ${at}`} />`)}
          ${model && !other && html`<${Picture} image=${first[at]?.predicted && frame} other=${first[at]?.predicted} caption="the difference" label="the difference" />
            <p class="key"><span><i class="brighter" /> recorded is brighter</span> <span><i class="darker" /> recorded is darker</span></p>`}
        </div>
        ${predicted.map(({ wrong }) => wrong && html`<p class="wrong" role="alert">No predictions: ${wrong}</p>`)}
        <${Controls} player=${player} count=${data.frames.length} />
        <p class="quiet">frame ${at} (0 to ${data.frames.length - 1}), ${(data.times_s[at] ?? 0).toFixed(1)} s${data.frame_count > data.frames.length ? `; the first ${data.frames.length} of ${data.frame_count} frames` : ""}</p>
      </div>
      <div>
        <${Choice} models=${fitting} model=${model} other=${other} dataset=${dataset} number=${number} />
        ${model && html`<${ErrorLane} moments=${[first, second]} models=${[model, other]} player=${player} />`}
        <${Channels} title="Actions" channels=${dataset.actions} rows=${data.actions} player=${player} />
        <${Channels} title="States" channels=${dataset.states} rows=${data.states} player=${player} />
      </div>
    </div>
    <footer><${Copy} curl=${() => curl("GET", path)} python=${() => requests("GET", path, undefined, "print(answer.json()[\"actions\"])")} /></footer>
  </div>`;
}

function usePlayer(data, period_s, start) {
  const [at, setAt] = useState(start);
  const [speed, setSpeed] = useState(1);
  const [is_playing, setPlaying] = useState(false);
  const count = data?.frames.length ?? 1;
  const place = Math.max(0, Math.min(at, count - 1));
  useEffect(() => {
    if (!is_playing) return undefined;
    const timer = setInterval(() => document.hidden || setAt(now => (now + 1) % count), (1000 * period_s) / speed);
    return () => clearInterval(timer);
  }, [is_playing, speed, count, period_s]);
  // The address follows when the player stands.
  useEffect(() => {
    if (!is_playing && data) note({ frame: place });
  }, [is_playing, place, data]);
  const jump = to => {
    setPlaying(false);
    setAt(Math.max(0, Math.min(count - 1, to)));
  };
  return { at: place, speed, setSpeed, is_playing, setPlaying, jump };
}

function Controls({ player, count }) {
  const { at, is_playing, setPlaying, jump, speed, setSpeed } = player;
  return html`<div class="toolbar">
    <button class="small" onClick=${() => setPlaying(!is_playing)} aria-label=${is_playing ? "pause" : "play"}>${is_playing ? "❚❚" : "▶"}</button>
    <button class="small" onClick=${() => jump(at - 1)} aria-label="one frame back">‹</button>
    <button class="small" onClick=${() => jump(at + 1)} aria-label="one frame on">›</button>
    <select class="small" aria-label="speed" value=${speed} onChange=${event => setSpeed(+event.target.value)}>${SPEEDS.map(one => html`<option value=${one}>${one}×</option>`)}</select>
    <input type="range" aria-label="frame" min="0" max=${count - 1} value=${at} onInput=${event => jump(+event.target.value)} />
  </div>`;
}

function Choice({ models, model, other, dataset, number }) {
  if (!models.length) return html`<p class="quiet">No model fits this data set: frame size, rate, channels and camera have to match.</p>`;
  const select = (label, value, name, words) => html`<label>${label} <select value=${value?.name ?? "none"} onChange=${event => note({ [name]: event.target.value })}>
    <option value="none">${words}</option>${models.map(one => html`<option value=${one.name}>${one.name}</option>`)}</select></label>`;
  return html`<div class="choice">${select("Model", model, "model", "none")}${model && select("compare with", other, "other", "nothing")}
    ${model && html`<button class="small" onClick=${() => go("play", { model: model.name, source: `set:${dataset.name}`, episode: number })}>play this episode live</button>`}</div>`;
}

function ErrorLane({ moments, models, player }) {
  const count = Math.max(...moments.map(one => one.length));
  const best = useMemo(() => bestGuess(moments[0]), [moments[0]]);
  const data = useMemo(() => {
    const lines = moments.filter((_, place) => models[place]).map(one => Array.from({ length: count }, (_, at) => (one[at]?.error === undefined ? null : levels(one[at].error))));
    const guess = Array.from({ length: count }, (_, at) => (moments[0][at]?.guess_errors ? levels(guessError(moments[0][at], best)) : null));
    return [Array.from({ length: count }, (_, at) => at), guess, ...lines];
  }, [count, ...moments]);
  const series = [{ label: `best simple guess: ${GUESSES[best]}`, color: "--quiet", dash: [4, 4], width: 1 }, ...models.filter(Boolean).map(({ name }, place) => ({ label: name, color: ["--orange", "--violet"][place], width: 2 }))];
  const worst = data[2].reduce((found, value, at) => (value > (data[2][found] ?? -1) ? at : found), 0);
  return html`<h2>Error of the prediction <button class="small" disabled=${data[2][worst] == null} onClick=${() => player.jump(worst)}>jump to the worst</button></h2>
    <${Plot} label="error of the prediction for each frame" data=${data} series=${series} height=${130} x="frame" y="gray levels" sync="episode" mark=${player.at} onPick=${player.jump} legend />`;
}

// Channels of one unit share a plot.
function Channels({ title, channels, rows, player }) {
  const groups = useMemo(() => {
    const by_unit = {};
    channels.forEach((channel, place) => (by_unit[channel.unit] ??= []).push({ ...channel, place }));
    const frames = rows.map((_, at) => at);
    return Object.entries(by_unit).map(([unit, members]) => ({
      unit, data: [frames, ...members.map(({ place }) => rows.map(row => row[place]))],
      series: members.map(({ name }, order) => ({ label: name, color: COLORS[order % COLORS.length] })),
    }));
  }, [rows, channels]);
  return channels.length > 0 && html`<h2>${title}</h2>${groups.map(({ unit, data, series }) => html`
    <${Plot} label=${`${title}: ${series.map(({ label }) => label).join(", ")}`} data=${data} series=${series} height=${110} y=${unit || " "} sync="episode" mark=${player.at} onPick=${player.jump} legend />`)}`;
}

const CARD_FRAMES = 20;

// The beginning of a data set in motion.
export function Moving({ dataset }) {
  const [frames, setFrames] = useState([]);
  const [turn, setTurn] = useState(0);
  const place = useRef();
  useEffect(() => {
    let timer = null, reading = null, is_gone = false;
    // Only what is in sight is read and moves.
    const watch = new IntersectionObserver(([{ isIntersecting }]) => {
      clearInterval(timer);
      if (!isIntersecting) return;
      reading ??= readEpisode(dataset.name, 0, 0, CARD_FRAMES).then(read => is_gone || setFrames(read.frames), () => { reading = null; });
      timer = setInterval(() => document.hidden || setTurn(now => now + 1), 1000 * Math.max(0.1, dataset.frame_period_s));
    });
    watch.observe(place.current);
    return () => {
      is_gone = true;
      clearInterval(timer);
      watch.disconnect();
    };
  }, [dataset.name, dataset.content_hash]);
  return html`<div ref=${place}><${Picture} image=${frames[turn % Math.max(1, frames.length)]} label=${`the beginning of ${dataset.name}`} note=${frames.length ? "" : "reading"} /></div>`;
}
