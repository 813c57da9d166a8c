// Play: the camera beside what the model predicted for it, one second ago.

import { html, useMemo, useState } from "./preact.js";
import { drivesAgainIn_s, isManual, letItDrive, Pad } from "./keys.js";
import { Mixed, Picture } from "./picture.js";
import { Plot } from "./plot.js";
import { contextBody } from "./predict.js";
import { useMoments } from "./robot.js";
import { AVERAGED, levels, NOVEL, novelty, noveltyClass, noveltyWord, share } from "./score.js";
import { takesActions } from "./server_lists.js";
import { Copy, curl, requests, streamInPython } from "./snippets.js";
import { VARIED } from "./sources.js";

const SPEEDS = [1, 2, 6];

export function Play({ robot }) {
  useMoments(robot);
  const [mode, setMode] = useState("beside");
  const [at, setAt] = useState(50);
  const { history, spec } = robot;
  const now = history.at(-1);
  // Kept over the beginning of an episode, dimmed.
  const compared = history.findLast(({ predicted }) => predicted);
  const predicted = history.findLast(({ prediction }) => prediction)?.prediction;
  const ahead_s = (spec.horizon * spec.frame_period_s).toFixed(1);
  const note = noteOf(robot, now);
  const is_old = compared !== now;
  // Words and numbers once a second: faster ones cannot be read, and cost more than the pictures.
  const verdict = useMemo(() => html`<${Verdict} robot=${robot} score=${share(history)} />`, [robot.second, robot.status]);
  const driving = useMemo(() => html`<${Driving} robot=${robot} />`, [robot.second, robot.status, isManual()]);
  return html`<section class="play">
    <h1 class="visually-hidden">Play</h1>
    <div class="three">
      <${Picture} image=${now?.frame} dim=${robot.status === "reconnecting"} caption="the camera now" label="the camera now" note=${now ? "" : note} />
      ${mode === "beside" ? html`<${Picture} image=${compared?.predicted} dim=${is_old} note=${note || (is_old ? `first prediction due in ${ahead_s} s` : "")}
          caption=${`predicted from ${ahead_s} s ago${takesActions(robot.model) ? " and the actions since" : ""}`} label=${`what was predicted for now, ${ahead_s} s ago`} />`
        : html`<${Mixed} image=${compared?.frame} other=${compared?.predicted} mode=${mode} at=${at} label="the camera and the prediction on one another"
          caption=${mode === "wipe" ? "left: camera, right: prediction" : "camera and prediction mixed"} />`}
      <${Picture} image=${compared?.frame} other=${compared?.predicted} dim=${is_old} caption="the difference" label="the difference between both"
        note=${note} />
    </div>
    <div class="toolbar">
      <span role="group" aria-label="Compare">${[["beside", "side by side"], ["overlay", "overlay"], ["wipe", "wipe"]].map(([name, words]) =>
        html`<button class="small" aria-pressed=${mode === name} onClick=${() => setMode(name)}>${words}</button>`)}</span>
      ${mode !== "beside" && html`<input type="range" min="0" max="100" value=${at} aria-label="how much of the prediction" onInput=${event => setAt(+event.target.value)} />`}
      <label class="quiet">Speed <select class="small" value=${robot.speed} onChange=${event => { robot.speed = +event.target.value; }}>
        ${SPEEDS.map(speed => html`<option value=${speed}>${speed}×, ${Math.round(speed / spec.frame_period_s)} frames/s</option>`)}</select></label>
      <span class="key"><i class="brighter" /> camera brighter <i class="darker" /> camera darker</span>
    </div>
    ${verdict}
    <h2>From now to +${ahead_s} s${takesActions(robot.model) ? ", if the action stays" : ""}</h2>
    <div class=${`strip ${robot.status === "running" ? "" : "dim"}`} style=${{ "--count": spec.horizon }}>
      ${Array.from({ length: spec.horizon }, (_, step) => html`<button class="enlarge" aria-label=${`predicted for +${label(spec, step)} s; enlarges`}>
        <${Picture} image=${predicted?.frames[step]} caption=${`+${label(spec, step)} s`} label=${`+${label(spec, step)} s`} note=${predicted ? "" : note} /></button>`)}
    </div>
    <div class="columns">
      <${Errors} history=${history} />
      ${driving}
    </div>
    <footer><${Copy} python=${() => program(robot)}
      curl=${() => curl("POST", `/v1/models/${robot.model.name}/predict`, predictionBody(robot), " -H 'Accept: image/png' -o prediction.png")} />
      <a href="/docs">API</a></footer>
  </section>`;
}

// A stream from the simulator; for a recording, one prediction of its present frames.
function program({ model, source_id, context }) {
  if (!source_id.startsWith("set:")) return streamInPython(model.name, model.lineage.scenario, source_id === VARIED);
  return requests("POST", `/v1/models/${model.name}/predict`, predictionBody({ model, context }));
}

function predictionBody({ model, context }) {
  const actions = takesActions(model) ? { actions: context.map(({ action }) => action) } : {};
  return { ...contextBody(model, context), ...actions };
}

const label = (spec, step) => ((step + 1) * spec.frame_period_s).toFixed(1);

export function noteOf(robot, now) {
  if (robot.status === "reconnecting") return "reconnecting";
  if (robot.status === "running") return "";
  return now ? `collecting ${robot.have} of ${robot.spec.context}` : "starting";
}

// One line in words with a bar, and the warning.
function Verdict({ robot, score }) {
  const novel = novelty(robot.history);
  const is_unlike = novel > NOVEL;
  const percent = score && !score.is_still ? 100 * score.of_guess : null;
  const words = !score ? "No prediction has come true yet"
    : score.is_still ? `Nothing moves; error ${levels(score.error).toFixed(1)} of 255 gray levels`
    : `Error ${percent < 1000 ? percent.toFixed(0) : ">999"} % of the best simple guess (${score.best})`;
  const warnings = robot.history.at(-1)?.prediction?.warnings ?? [];
  return html`<div class=${`verdict ${is_unlike ? "bad" : ""}`}>
    <p class="line"><b>${words}</b>
      ${novel !== null && html`<span>; novelty <b class=${noveltyClass(novel)}>${noveltyWord(novel)}</b></span>`}</p>
    <div class="bar" role="img" aria-label=${percent === null ? "no error yet" : `error ${percent.toFixed(0)} percent of that of ${score.best}`}>
      <span class=${percent === null ? "" : percent < 100 ? "good" : "bad"} style=${{ width: `${Math.min(100, (percent ?? 0) / 2)}%` }} />
      <i style=${{ left: "50%" }} /></div>
    <p class="ends"><span>0 %: perfect</span><span>100 %: no better than ${score?.best ?? "a copy"}</span><span>200 %</span></p>
    <p class="quiet small-print">Compared, over the last ${AVERAGED} frames, with the best of three guesses without a model: a copy of the last frame that the model saw, that copy turned as the robot has turned since, and the mean of the frames that it saw. A model's skill is measured against stronger ones.</p>
    <p class="warning" role="status">${is_unlike ? "Unlike the training data: do not trust this." : warnings[0] ?? ""}</p>
  </div>`;
}

const ERROR_LINES = [
  { label: "low", color: "--blue", width: 0 }, { label: "high", color: "--blue", width: 0 },
  { label: "expected", color: "--blue", dash: [5, 4] }, { label: "actual", color: "--orange", width: 2 },
];

function Errors({ history }) {
  const compared = history.filter(({ error }) => error !== undefined);
  const latest = history.at(-1)?.at_s ?? 0;
  const data = useMemo(() => {
    const of = value => compared.map(moment => (value(moment) === undefined ? null : levels(value(moment))));
    return [compared.map(({ at_s }) => at_s - latest), of(({ band }) => band?.[0]), of(({ band }) => band?.[1]), of(({ expected }) => expected), of(({ error }) => error)];
    // Once a second is enough for half a minute, and costs a fifth.
  }, [Math.floor(latest), compared.length < 10 && compared.length]);
  return html`<div><h2>Error over the last 30 s</h2>
    <${Plot} label="expected and actual error of the last 30 seconds" data=${data} series=${ERROR_LINES} bands=${[[2, 1]]} height=${170} x="seconds" y="gray levels" range=${(_, low, high) => [0, Math.max(10, high * 1.1)]} />
    <p class="key"><i class="line orange" /> actual <i class="line dashed" /> expected, with its 90 % band</p></div>`;
}

function Driving({ robot }) {
  const now = robot.history.at(-1);
  const moves = takesActions(robot.model) && now?.action?.length
    ? robot.spec.actions.map(({ name, unit }, place) => `${name} ${now.action[place].toFixed(2)} ${unit}`).join(", ") : "";
  if (!robot.source) return html`<div><h2>Drive</h2><p class="quiet">${noteOf(robot, now)}</p></div>`;
  if (!robot.is_drivable) {
    return html`<div><h2>Source</h2><p class="driver">${!robot.source_id.startsWith("set:") ? "A standing camera: there is nothing to drive." : "A recorded episode: its actions are recorded too."}</p>
      <p class="quiet">${moves}</p></div>`;
  }
  const by = isManual() ? `You drive; automatic again in ${drivesAgainIn_s()} s` : "It drives itself until you touch a key";
  return html`<div><h2>Drive</h2><${Pad} />
    <p class="driver">${by}${isManual() && html` <button class="small" onClick=${letItDrive}>let it drive</button>`}</p><p class="quiet">${moves}</p></div>`;
}
