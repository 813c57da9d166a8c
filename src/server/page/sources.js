// Where frames come from: the simulator, or a recorded episode. And which sources fit a model.

import { call, deleteAtEnd, get } from "./api.js";
import { SIMULATOR_CAMERA } from "./camera.js";
import { fromPng } from "./gray.js";
import { estimatesDepth, takesActions, takesState } from "./server_lists.js";

const SIMULATOR_ACTIONS = ["linear", "angular"];
export const SIMULATOR_STATES = ["x", "y", "heading_cos", "heading_sin", "linear", "angular"];
// Each episode in a room of its own.
export const VARIED = "simulator:varied";

const names = channels => channels.map(({ name }) => name);
const areEqual = (one, other) => one.length === other.length && one.every((name, index) => name === other[index]);
const isNear = (one, other) => Math.abs(one - other) <= 0.01 * Math.abs(other);

const fitsSimulator = model => Boolean(model.lineage.scenario)
  && (!takesActions(model) || areEqual(names(model.spec.actions), SIMULATOR_ACTIONS))
  && (!takesState(model) || areEqual(names(model.spec.states), SIMULATOR_STATES));

const remembersRoom = model => Boolean(model.spec.flow?.memory);
// Of the simulated data sets, only those with a room and a camera of its own for each episode have no common camera.
const hasVariedRooms = dataset => Boolean(dataset.scenario) && !dataset.camera;

// Whether a model can predict a data set: frame size and rate, channels, camera, and simulated or recorded have to match. A model that
// remembers a room knows no others.
export function fits(model, dataset) {
  const { spec, lineage } = model;
  const have_cameras = spec.camera && dataset.camera;
  return spec.frame_width_px === dataset.frame_width_px && spec.frame_height_px === dataset.frame_height_px
    && isNear(dataset.frame_period_s, spec.frame_period_s)
    && (!takesActions(model) || areEqual(names(spec.actions), names(dataset.actions)))
    && (!takesState(model) || areEqual(names(spec.states), names(dataset.states)))
    && Boolean(lineage.scenario) === Boolean(dataset.scenario)
    && !(remembersRoom(model) && hasVariedRooms(dataset))
    && (!have_cameras || isNear(dataset.camera.horizontal_fov_rad, spec.camera.horizontal_fov_rad));
}

// The sources that a model can be offered: { id, label }.
export function sourcesOf(model, datasets) {
  const knowsAnyRoom = estimatesDepth(model) && !remembersRoom(model);
  const varied = knowsAnyRoom ? [{ id: VARIED, label: "simulator, varied rooms" }] : [];
  const simulator = fitsSimulator(model) ? [...varied, { id: "simulator", label: varied.length ? "simulator, one room" : "simulator" }] : [];
  const fitting = (datasets ?? []).filter(dataset => fits(model, dataset));
  return [...simulator, ...fitting.map(({ name }) => ({ id: `set:${name}`, label: `recorded: ${name}` }))];
}

export function openSource(model, id, episode) {
  return id.startsWith("set:") ? Recording.open(id.slice(4), episode) : Simulator.open(model, id === VARIED);
}

// A simulated robot on the server. A moment is what is known at a frame: the frame, the state, the driver's next action, the true
// poses, whether an episode begins, and the camera where each episode has its own.
class Simulator {
  static async open(model, is_varied) {
    const { frame_period_s, frame_width_px, frame_height_px, camera } = model.spec;
    const scenario = model.lineage.scenario;
    const stands = scenario === "static-observer";
    const world = { frame_period_s, frame_width_px, frame_height_px, max_duration_s: stands ? 30 : 3600 };
    if (is_varied) world.rooms = "varied";
    else if (camera) world.camera = { ...SIMULATOR_CAMERA, horizontal_fov_rad: camera.horizontal_fov_rad, tilt_down_rad: camera.tilt_down_rad };
    const seed = Math.floor(Math.random() * 2 ** 32);
    const made = await call("POST", "/v1/environments", { scenario, seed, world });
    return new Simulator(made, !stands, await moment(made, null));
  }

  constructor({ id }, is_drivable, first) {
    this.path = `/v1/environments/${id}`;
    this.is_drivable = is_drivable;
    this.first = this.latest = first;
    this.leave = () => deleteAtEnd(this.path);
    addEventListener("pagehide", this.leave);
  }

  async step(action) {
    const step = await call("POST", `${this.path}/step`, { action });
    const is_over = step.terminated || step.truncated;
    this.latest = await moment(is_over ? await call("POST", `${this.path}/reset`, {}) : step, is_over ? null : this.latest);
    return this.latest;
  }

  close() {
    removeEventListener("pagehide", this.leave);
    this.leave();
  }
}

// `before` is null where an episode begins.
async function moment({ observation, info }, before) {
  const frame = await fromPng(observation.frame);
  const camera = before ? before.camera : roomCamera(info.trial?.room);
  return { frame, state: observation.state, driver: info.policy_action, poses: info.poses, begins: !before, camera };
}

// A model has no use for the noise of the room's camera.
function roomCamera(room) {
  if (!room) return undefined;
  const { height_m, horizontal_fov_rad, tilt_down_rad } = room.camera;
  return { height_m, horizontal_fov_rad, tilt_down_rad };
}

const EPISODE_FRAMES = 300;

// The frames of a recorded episode with what belongs to them, decoded.
export async function readEpisode(dataset, episode, from = 0, limit = EPISODE_FRAMES) {
  const read = await get(`/v1/datasets/${dataset}/episodes/${episode}?from=${from}&limit=${limit}`);
  const frames = [];
  // One after another, so that memory does not hold all decoded bitmaps at once.
  for (const frame of read.frames) frames.push(await fromPng(frame));
  return { ...read, frames };
}

// A recorded episode, over and over. It cannot be driven: its actions are recorded too.
class Recording {
  static async open(dataset, episode = 0) {
    return new Recording(await readEpisode(dataset, episode));
  }

  constructor(episode) {
    this.is_drivable = false;
    this.episode = episode;
    this.at = 0;
    this.first = this.moment();
  }

  moment() {
    const { frames, states, actions, camera } = this.episode;
    return { frame: frames[this.at], state: states[this.at], driver: actions[this.at] ?? [], begins: this.at === 0, camera };
  }

  async step() {
    this.at = (this.at + 1) % this.episode.frames.length;
    return this.moment();
  }

  close() {}
}
