// Dream: the camera is cut, and the model goes on from its own frames; beside it, what really happens.

import { html, useEffect, useLayoutEffect, useMemo, useState } from "./preact.js";
import { encodeGif } from "./gif.js";
import { Gray, mse } from "./gray.js";
import { heldAction, isManual, Pad } from "./keys.js";
import { Picture } from "./picture.js";
import { noteOf } from "./play.js";
import { Plot } from "./plot.js";
import { contextBody } from "./predict.js";
import { useMoments } from "./robot.js";
import { levels, NOVEL, noveltyClass, noveltyWord } from "./score.js";
import { takesActions, takesState } from "./server_lists.js";
import { Copy, curl, requests } from "./snippets.js";
import { SIMULATOR_STATES } from "./sources.js";
import { sendAll, Stream } from "./stream.js";

// As long as a dream can be saved.
const MOST_FRAMES = 300;

// Why a model cannot dream; an empty text if it can.
function whyNot(model) {
  const names = model.spec.states.map(({ name }) => name).join();
  const is_known = !takesState(model) || names === SIMULATOR_STATES.join();
  return is_known ? "" : "The model takes a state that this page cannot compute from the actions.";
}

// The state after an action, by dead reckoning from the commands.
function reckon([x, y, cos, sin, linear, angular], [speed, turn], period_s) {
  const [middle_speed, middle_turn] = [(linear + speed) / 2, (angular + turn) / 2];
  const heading = Math.atan2(sin, cos), half = heading + (middle_turn * period_s) / 2;
  const end = heading + middle_turn * period_s;
  return [x + middle_speed * Math.cos(half) * period_s, y + middle_speed * Math.sin(half) * period_s, Math.cos(end), Math.sin(end), speed, turn];
}

class Dreaming {
  constructor(robot) {
    this.robot = robot;
    // What was imagined and what really came: { imagined, real, novelty, error }.
    this.moments = [];
    // The end closes the stream under a step; the robot goes on.
    this.follow = moment => this.step(moment).catch(error => { if (!this.is_over) throw error; });
    robot.beside = this.follow;
  }

  nextState(state, action) {
    return takesState(this.robot.model) ? reckon(state, action, this.robot.spec.frame_period_s) : undefined;
  }

  // The model's answer to its context: the first imagined frame is that of the moment that comes now.
  async fallAsleep() {
    const { context, model } = this.robot;
    this.stream = await Stream.open(model, context.at(-1).camera);
    if (this.is_over) return this.stream.close();
    const answer = await sendAll(this.stream, context);
    const last = context.at(-1);
    [this.frame, this.novelty, this.state] = [answer.frames[0], answer.novelty, this.nextState(last.state, last.action)];
  }

  async step(moment) {
    if (this.is_over || this.moments.length >= MOST_FRAMES) return;
    if (!this.stream && this.robot.context.length < this.robot.spec.context) return;
    if (!this.stream) await this.fallAsleep();
    if (this.is_over) return;
    const { model, is_drivable } = this.robot;
    // A recording does not follow the keys, and a new episode has nothing to do with the dream.
    const is_manual = isManual();
    this.is_alone ||= moment.begins || (is_manual && !is_drivable);
    const action = !is_drivable && is_manual ? heldAction(model) : moment.action;
    const real = this.is_alone ? null : moment.frame;
    this.moments.push({ imagined: this.frame, real, novelty: this.novelty, error: real ? mse(this.frame, real) : null });
    const answer = await this.stream.send({ frame: this.frame, action, state: this.state, steps: 1 });
    [this.frame, this.novelty, this.state] = [answer.frames[0], answer.novelty, this.nextState(this.state, action)];
  }

  end() {
    this.is_over = true;
    // A next dream may have begun before this end: effects run after the picture is drawn.
    if (this.robot.beside === this.follow) this.robot.beside = async () => {};
    this.stream?.close();
  }
}

export function Dream({ robot }) {
  useMoments(robot);
  const [dream, setDream] = useState(null);
  const why_not = whyNot(robot.model);
  // Of the state that is, not of the one drawn last: two presses may come between two pictures.
  const toggle = () => setDream(present => (present ? null : new Dreaming(robot)));
  useEffect(() => () => dream?.end(), [dream]);
  // The server went away, and with it the dream's stream.
  useEffect(() => {
    if (robot.status === "reconnecting") setDream(null);
  }, [robot.status]);
  // With the picture, not after it: the key works as soon as the button is seen.
  useLayoutEffect(() => {
    const pressed = event => {
      if (event.key !== " " || event.target.closest?.("button, input, select, textarea") || why_not) return;
      event.preventDefault();
      toggle();
    };
    addEventListener("keydown", pressed);
    return () => removeEventListener("keydown", pressed);
  });
  const now = robot.history.at(-1), last = dream?.moments.at(-1);
  const note = noteOf(robot, now);
  const shade = last?.novelty === undefined ? "good" : noveltyClass(last.novelty);
  const imagined_s = (dream?.moments.length ?? 0) * robot.spec.frame_period_s;
  if (why_not) return html`<div class="empty"><h1>“${robot.model.name}” cannot dream here</h1><p>${why_not}</p></div>`;
  return html`<section class="dream">
    <h1 class="visually-hidden">Dream</h1>
    <div class="columns">
      <div class="two">
        <${Picture} image=${last?.imagined ?? now?.frame} className=${last ? `dreaming is-${shade}` : ""} note=${note} dim=${robot.status === "reconnecting"}
          caption=${last ? "imagined: the model's own frames" : "the camera; not cut yet"} label=${last ? "the imagined frame" : "the camera"} />
        <${Picture} image=${last ? last.real : now?.frame} caption=${robot.source_id.startsWith("set:") ? "what was recorded" : "the true simulator"} label="what really happens"
          note=${dream?.is_alone ? (robot.is_drivable ? "a new episode: no comparison" : "does not follow your keys") : note} />
      </div>
      <div>
        <p class="imagined">${imagined_s.toFixed(1)} s imagined</p>
        <p><button class="main" onClick=${toggle} disabled=${!dream && robot.status !== "running"}>${dream ? "Open the camera again" : "Cut the camera"} <kbd>Space</kbd></button>
        ${" "}<button onClick=${event => { save(dream, robot); letSpaceCut(event); }} disabled=${!dream || dream.moments.length < 2}>Save GIF</button></p>
        <div class="meter"><p>Novelty ${last?.novelty === undefined ? "" : html`<b class=${shade}>${noveltyWord(last.novelty)}</b>`}</p>
          <div class="bar" role="img" aria-label=${`novelty ${last?.novelty?.toFixed(2) ?? "unknown"}`}><span class=${shade} style=${{ width: `${100 * (last?.novelty ?? 0)}%` }} /></div>
          <p class="ends"><span>like the training data</span><span>unlike it</span></p></div>
        <p class="wrong" role="status">${last?.novelty > NOVEL ? "Unlike the training data: do not trust this." : ""}</p>
        ${takesActions(robot.model) && html`<${Pad} />`}
        <p class="quiet">${whatItGets(robot.model, dream)}</p>
      </div>
    </div>
    ${dream ? html`<${Drift} dream=${dream} period_s=${robot.spec.frame_period_s} />` : html`<${Before} robot=${robot} note=${note} />`}
    <footer><${Copy} curl=${() => curl("POST", `/v1/models/${robot.model.name}/predict`, body(robot))} python=${() => requests("POST", `/v1/models/${robot.model.name}/predict`, body(robot))} /></footer>
  </section>`;
}

function whatItGets(model, dream) {
  if (!takesActions(model)) return dream ? "The model gets no camera frame." : "Cut the camera: the model goes on from its own frames.";
  return dream ? "The model gets no camera frame, only the robot's actions." : "Cut the camera: the model goes on from its own frames, under your keys.";
}

// What a dream is, and how one would begin.
function Before({ robot, note }) {
  const { spec, history } = robot;
  const frames = history.findLast(({ prediction }) => prediction)?.prediction.frames ?? [];
  const ahead_s = step => ((step + 1) * spec.frame_period_s).toFixed(1);
  return html`<h2>The next ${ahead_s(spec.horizon - 1)} s, as a dream would begin now</h2>
    <div class="strip" style=${{ "--count": spec.horizon }}>${Array.from({ length: spec.horizon }, (_, step) => html`
      <${Picture} image=${frames[step]} caption=${`+${ahead_s(step)} s`} label=${`imagined for +${ahead_s(step)} s`} note=${frames.length ? "" : note} />`)}</div>
    <p class="quiet">A model predicts ${spec.horizon} frames. In a dream it takes its own first frame for the camera's, predicts again, and so on, for as long as you like: its mistakes add up. The picture on the right shows what really happens meanwhile, and a plot shows how far they are apart.</p>`;
}

const DRIFT_LINES = [{ label: "error", color: "--orange", width: 2 }];
function Drift({ dream, period_s }) {
  const count = dream?.moments.length ?? 0;
  const data = useMemo(() => {
    const moments = dream?.moments ?? [];
    return [moments.map((_, place) => (place + 1) * period_s), moments.map(({ error }) => (error === null ? null : levels(error)))];
  }, [count, dream]);
  return html`<h2>How far the dream is from the truth</h2>
    <${Plot} label="error of the imagined frames over time" data=${data} series=${DRIFT_LINES} height=${150} x="seconds imagined" y="gray levels" range=${(_, low, high) => [0, Math.max(20, high * 1.1)]} />`;
}

// A prediction of three horizons from the present context: what a dream does, in one request.
function body(robot) {
  const { context, spec, model } = robot, last = context.at(-1);
  const steps = 3 * spec.horizon;
  return {
    ...contextBody(model, context), steps, ...(takesActions(model) && { plan: Array(steps).fill(last?.action) }),
  };
}

// After a click with the pointer, the space bar is for the camera again.
function letSpaceCut({ detail, currentTarget }) {
  if (detail) currentTarget.blur();
}

const SCALE = 3;
const GAP = 6;

// The dream and the truth beside one another, enlarged.
function save(dream, robot) {
  const images = dream.moments.map(({ imagined, real }) => sideBySide(imagined, real));
  const url = URL.createObjectURL(encodeGif(images, 1000 * robot.spec.frame_period_s));
  Object.assign(document.createElement("a"), { href: url, download: `dream-${robot.model.name}.gif` }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

function sideBySide(one, other) {
  const width = SCALE * one.width * 2 + GAP, height = SCALE * one.height;
  const pixels = new Uint8Array(width * height).fill(255);
  [one, other].forEach((image, place) => {
    const left = place * (SCALE * one.width + GAP);
    for (let y = 0; image && y < height; y++) {
      for (let x = 0; x < SCALE * image.width; x++) {
        pixels[y * width + left + x] = image.pixels[Math.floor(y / SCALE) * image.width + Math.floor(x / SCALE)];
      }
    }
  });
  return new Gray(width, height, pixels);
}
