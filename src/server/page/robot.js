// A robot and a model that predicts its frames: the loop that Play, Dream and What if share.

import { useEffect, useState } from "./preact.js";
import { Locked, pause } from "./api.js";
import { cameraOf } from "./camera.js";
import { heldAction, isManual } from "./keys.js";
import { compare, lookBack } from "./score.js";
import { openSource } from "./sources.js";
import { sendAll, Stream } from "./stream.js";

const HISTORY_S = 30;
const FIRST_WAIT_MS = 200;
const LONGEST_WAIT_MS = 3000;

export class Robot {
  constructor(model, source_id, episode) {
    Object.assign(this, { model, source_id, episode, spec: model.spec });
    // Moments, the latest last: see sources.js; with action and prediction, and how it compares with what was predicted for it.
    this.history = [];
    // starting, collecting, running or reconnecting.
    this.status = "starting";
    this.have = 0;
    this.speed = 1;
    // While true, the robot stands; What if shows what it could do.
    this.is_held = false;
    // For how long it did not move: hidden or held. Its times leave this out.
    this.rested_ms = 0;
    // Actions that it has to carry out first.
    this.plan = [];
    // Called with each moment and its action before the next one: Dream's step.
    this.beside = async () => {};
    this.listeners = new Set();
    this.wake = () => {};
    this.visible = () => this.wake();
    document.addEventListener("visibilitychange", this.visible);
    this.run();
  }

  tell() {
    for (const listener of this.listeners) listener();
  }

  get is_drivable() {
    return this.source?.is_drivable ?? false;
  }

  // Which second the last moment is of; fast robots change it sooner.
  get second() {
    return Math.floor((this.history.at(-1)?.at_s ?? 0) * this.speed);
  }

  // The moments of the present episode, as far as they are kept.
  get episode_moments() {
    return this.history.slice(Math.max(0, this.history.findLastIndex(({ begins }) => begins)));
  }

  // Those that the model's context holds.
  get context() {
    return this.episode_moments.slice(-this.spec.context);
  }

  // Whether the present episode is long enough for a prediction that has come true.
  get is_warm() {
    return this.episode_moments.length >= this.spec.context + this.spec.horizon;
  }

  hold(is_held) {
    this.is_held = is_held;
    this.wake();
  }

  carryOut(plan) {
    this.plan = [...plan];
    this.wake();
  }

  nextAction(moment) {
    if (this.plan.length) return this.plan.shift();
    return this.is_drivable && isManual() ? heldAction(this.model) : moment.driver;
  }

  async run() {
    for (let wait_ms = FIRST_WAIT_MS; !this.is_closed; wait_ms = Math.min(1.5 * wait_ms, LONGEST_WAIT_MS)) {
      try {
        await this.connect();
        while (!this.is_closed) {
          await this.tick();
          wait_ms = FIRST_WAIT_MS;
        }
        this.disconnect();
      } catch (error) {
        this.disconnect();
        if (this.is_closed || error instanceof Locked) return;
        this.status = "reconnecting";
        this.tell();
        await pause(wait_ms);
      }
    }
  }

  async connect() {
    this.source = await openSource(this.model, this.source_id, this.episode);
    this.now = this.source.first;
  }

  disconnect() {
    this.closeStreams();
    this.source?.close();
    this.source = null;
  }

  async tick() {
    const waited_from_ms = performance.now();
    while ((document.hidden || (this.is_held && !this.plan.length && this.status === "running")) && !this.is_closed) {
      await new Promise(wake => { this.wake = wake; });
    }
    if (this.is_closed) return;
    const started_ms = performance.now();
    this.rested_ms += started_ms - waited_from_ms;
    const moment = this.now;
    // A stream has the context of one episode.
    if (moment.begins || !this.stream || this.stream.socket.readyState !== WebSocket.OPEN) await this.openStreams();
    moment.action = this.nextAction(moment);
    const [answer, next, comparison] = await Promise.all([this.stream.send(moment), this.source.step(moment.action), this.compare(moment), this.beside(moment)]);
    this.receive(Object.assign(moment, comparison), answer);
    this.now = next;
    this.tell();
    // Until the first comparison of an episode, frames are taken as fast as they come: nobody wants to wait for them.
    const period_ms = this.is_warm ? (1000 * this.spec.frame_period_s) / this.speed : 0;
    await pause(Math.max(0, period_ms - (performance.now() - started_ms)));
  }

  // A new stream, with the context so far, and one for what was predicted a horizon ago, with the context of then.
  async openStreams() {
    this.closeStreams();
    const { model, now, spec: { horizon, context } } = this;
    this.stream = await Stream.open(model, now.camera);
    this.late = await Stream.open(model, now.camera);
    if (now.begins) return;
    await sendAll(this.stream, this.context.slice(1 - context));
    await sendAll(this.late, this.episode_moments.slice(0, -horizon).slice(1 - context));
  }

  closeStreams() {
    this.stream?.close();
    this.late?.close();
    this.stream = this.late = null;
  }

  // How the moment compares with what the model predicts for it from the frames up to `horizon` ago and the actions since. The late
  // stream has the frames before: one frame and one message are less work than a request with a whole context.
  async compare(moment) {
    const moments = moment.begins ? [moment] : [...this.episode_moments, moment];
    const { horizon } = this.spec;
    if (moments.length <= horizon) return null;
    const since = moments.slice(-horizon - 1, -1);
    const answer = await this.late.send({ ...since[0], plan: since.map(({ action }) => action) });
    const past = lookBack(moments, this.spec);
    return past && answer.type === "prediction" ? compare(moment, past, answer, this.spec, moment.camera ?? cameraOf(this.model)) : null;
  }

  receive(moment, answer) {
    moment.at_s = (performance.now() - this.rested_ms) / 1000;
    if (answer.type === "prediction") moment.prediction = answer;
    this.history.push(moment);
    this.status = answer.type === "prediction" ? "running" : "collecting";
    this.have = answer.have ?? this.spec.context;
    const kept = Math.ceil(HISTORY_S / this.spec.frame_period_s) + this.spec.horizon + this.spec.context;
    if (this.history.length > kept) this.history.shift();
  }

  close() {
    this.is_closed = true;
    document.removeEventListener("visibilitychange", this.visible);
    this.disconnect();
    this.wake();
  }
}

// Draws the component again after every moment of the robot.
export function useMoments(robot) {
  const [, setTurn] = useState(0);
  useEffect(() => {
    const listener = () => setTurn(turn => turn + 1);
    robot?.listeners.add(listener);
    return () => robot?.listeners.delete(listener);
  }, [robot]);
}
