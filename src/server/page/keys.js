// Driving by keys and touch. What is held is common to all views.

import { html, useEffect, useState } from "./preact.js";

const KEYS = { w: "ahead", arrowup: "ahead", s: "back", arrowdown: "back", a: "left", arrowleft: "left", d: "right", arrowright: "right" };
const BUTTONS = [["ahead", "W", "▲"], ["left", "A", "◀"], ["back", "S", "▼"], ["right", "D", "▶"]];
// For the simulated robot, in m/s and rad/s.
const SPEED_M_S = 0.35;
const TURN_RAD_S = 0.9;
// After so long without a key, the robot drives itself again.
const PATIENCE_MS = 10_000;

const held = new Set();
const listeners = new Set();
let touched_ms = -Infinity;

function hold(name, down) {
  if (down === held.has(name)) return;
  if (down) held.add(name);
  else held.delete(name);
  touched_ms = performance.now();
  for (const listener of listeners) listener();
}

export const isManual = () => held.size > 0 || performance.now() - touched_ms < PATIENCE_MS;
export const drivesAgainIn_s = () => Math.ceil((PATIENCE_MS - (performance.now() - touched_ms)) / 1000);
export function letItDrive() {
  held.clear();
  touched_ms = -Infinity;
  for (const listener of listeners) listener();
}

const TURNS = ["angular", "angle", "steer", "steering", "yaw", "yaw_rate"];
const SPEEDS = ["linear", "throttle", "speed", "velocity"];

// The action for how much ahead and left (-1 to 1 each), in the order of the channels. The simulated robot's limits are known; for
// others, two standard deviations of the training data around the mean, inside of the model's bounds.
export function actionFor({ spec, action_bounds = [] }, ahead, left) {
  return spec.actions.map(({ name, unit, mean, std }, place) => {
    const pull = TURNS.includes(name) ? left : SPEEDS.includes(name) ? ahead : 0;
    if (name === "linear" && unit === "m/s") return SPEED_M_S * pull;
    if (name === "angular" && unit === "rad/s") return TURN_RAD_S * pull;
    // Most cars count steering to the right.
    const wanted = mean + 2 * std * (["angle", "steer", "steering"].includes(name) ? -pull : pull);
    const { low = -Infinity, high = Infinity } = action_bounds[place] ?? {};
    return Math.min(Math.max(wanted, low), high);
  });
}

export function heldAction(model) {
  const pull = (plus, minus) => held.has(plus) - held.has(minus);
  return actionFor(model, pull("ahead", "back"), pull("left", "right"));
}

// A slider needs only its arrows.
const isTypedInto = ({ key, target: { tagName, type } }) => ["SELECT", "INPUT", "TEXTAREA"].includes(tagName) && (type !== "range" || key.startsWith("Arrow"));

function onKey(event, down) {
  const name = KEYS[event.key.toLowerCase()];
  if (!name || event.ctrlKey || event.metaKey || event.altKey) return;
  if (down && (!listeners.size || isTypedInto(event))) return;
  event.preventDefault();
  hold(name, down);
}
addEventListener("keydown", event => onKey(event, true));
addEventListener("keyup", event => onKey(event, false));
addEventListener("blur", () => [...held].forEach(name => hold(name, false)));

// Four buttons; the keys count while they are shown.
export function Pad() {
  const [, setTurn] = useState(0);
  useEffect(() => {
    const listener = () => setTurn(turn => turn + 1);
    listeners.add(listener);
    return () => {
      listeners.delete(listener);
      held.clear();
    };
  }, []);
  const up = name => () => hold(name, false);
  // A focused button is held by its keys, too; Space means something else in a view.
  const byKey = (name, down) => event => {
    if (event.key !== " " && event.key !== "Enter") return;
    event.preventDefault();
    event.stopPropagation();
    hold(name, down);
  };
  return html`<div class="pad" role="group" aria-label="Drive">${BUTTONS.map(([name, key, arrow]) => html`
    <button class=${`${name} ${held.has(name) ? "down" : ""}`} aria-label=${`drive ${name}`} aria-pressed=${held.has(name)}
      onPointerDown=${() => hold(name, true)} onPointerUp=${up(name)} onPointerCancel=${up(name)} onPointerLeave=${up(name)}
      onKeyDown=${byKey(name, true)} onKeyUp=${byKey(name, false)} onBlur=${up(name)}
      onContextMenu=${event => event.preventDefault()}><span aria-hidden="true">${arrow}</span><kbd>${key}</kbd></button>`)}
  </div>`;
}
