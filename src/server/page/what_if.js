// What if: several plans from the present frame, what the model predicts for each, and where they lead.

import { html, useEffect, useRef, useState } from "./preact.js";
import { call } from "./api.js";
import { mse } from "./gray.js";
import { actionFor } from "./keys.js";
import { Picture } from "./picture.js";
import { noteOf } from "./play.js";
import { useMoments } from "./robot.js";
import { contextBody, decode } from "./predict.js";
import { levels } from "./score.js";
import { takesActions, useLists } from "./server_lists.js";
import { Copy, curl, requests } from "./snippets.js";

// Name, how much ahead, how much left, color.
const PLANS = [
  ["hard left", 0.6, 1.4, "--blue"], ["left", 1, 0.6, "--teal"], ["straight", 1, 0, "--green"], ["right", 1, -0.6, "--orange"],
  ["hard right", 0.6, -1.4, "--red"], ["slow", 0.3, 0, "--violet"], ["fast", 1.3, 0, "--ink"], ["back", -0.6, 0, "--quiet"],
  ["stop", 0, 0, "--line"],
];

// The present: the frame that no action followed yet, and those before it.
function present(robot) {
  if (robot.status !== "running" || robot.plan.length || !robot.now || robot.now.begins) return null;
  const context = [...robot.context, robot.now].slice(-robot.spec.context);
  return context.length === robot.spec.context ? context : null;
}

function requestFor(robot, context) {
  const plans = PLANS.map(([, ahead, left]) => Array(robot.spec.horizon).fill(actionFor(robot.model, ahead, left)));
  return { ...contextBody(robot.model, context), plans };
}

const path = robot => `/v1/models/${robot.model.name}/rollouts`;

async function compareAll(robot, context) {
  const request = requestFor(robot, context);
  const answer = await call("POST", path(robot), request);
  return PLANS.map(([name, , , color], place) => ({
    name, color, actions: request.plans[place],
    frames: decode(answer.rollouts[place], robot.spec),
    expected: answer.expected_mse?.[place]?.at(-1),
  }));
}

export function WhatIf({ robot }) {
  useMoments(robot);
  const { connection } = useLists();
  const [goal, setGoal] = useState(null);
  const [plans, setPlans] = useState([]);
  const [follows, setFollows] = useState(false);
  const [wrong, setWrong] = useState("");
  const frame = robot.now?.frame;
  useEffect(() => {
    robot.hold(true);
    return () => {
      robot.plan = [];
      robot.hold(false);
    };
  }, [robot]);
  useEffect(() => {
    const context = takesActions(robot.model) && present(robot);
    if (!context) return undefined;
    let is_gone = false;
    setGoal(known => known ?? context.at(-1).frame);
    compareAll(robot, context).then(made => { if (!is_gone) { setPlans(made); setWrong(""); } }, error => is_gone || setWrong(error.message));
    return () => { is_gone = true; };
  }, [robot, robot.now, robot.status, robot.plan.length]);
  const costs = plans.map(({ frames }) => (goal ? mse(frames.at(-1), goal) : 0));
  const best = costs.indexOf(Math.min(...costs));
  const take = plan => robot.carryOut(plan.actions);
  // A robot that stands asks nothing of the server, so only the events tell that it is away.
  const is_away = !robot.source || robot.status === "reconnecting" || ["reconnecting", "stopping"].includes(connection);
  useEffect(() => {
    if (!follows || !plans.length || !robot.is_drivable || is_away) return undefined;
    const soon = setTimeout(() => take(plans[best]), 1200);
    return () => clearTimeout(soon);
  }, [follows, plans, is_away]);
  const step = useAnimation(robot);
  const horizon_s = (robot.spec.horizon * robot.spec.frame_period_s).toFixed(1);
  if (!takesActions(robot.model)) {
    return html`<div class="empty"><h1>“${robot.model.name}” takes no actions</h1><p>Without actions there is nothing to choose between. Take a model with actions.</p></div>`;
  }
  const note = plans.length ? (robot.status === "reconnecting" ? "reconnecting" : "") : noteOf(robot, robot.history.at(-1)) || "asking the model";
  const is_moving = robot.plan.length > 0;
  // Not `disabled`, which would take the focus away from who presses it by a key.
  const can_take = plans.length > 0 && !is_moving && !is_away && robot.is_drivable;
  return html`<section class="what-if">
    <h1 class="visually-hidden">What if</h1>
    <p>Nine ways to drive for the next ${horizon_s} s, each as the model expects the camera to see it. <b>Best</b> is the one that ends with the view that is most like the goal: that picture you choose.</p>
    <div class="overview">
      <${Picture} image=${frame} caption="the present frame" label="the present frame" note=${frame ? "" : note} dim=${robot.status === "reconnecting"} />
      <${Picture} image=${goal} caption="the goal: what to see in the end" label="the goal" note=${goal ? "" : note} />
      <figure class="picture"><figcaption>from above</figcaption><${Ways} robot=${robot} plans=${plans} best=${best} /></figure>
    </div>
    <div class="toolbar">
      <button onClick=${() => setGoal(frame)} disabled=${!frame}>make the present frame the goal</button>
      <button class="main" aria-disabled=${!can_take} onClick=${() => can_take && take(plans[best])}>take the best</button>
      <label><input type="checkbox" checked=${follows} disabled=${!robot.is_drivable} onChange=${event => setFollows(event.target.checked)} /> keep taking the best</label>
      ${is_away ? html`<span class="quiet">${noteOf(robot, robot.history.at(-1)) || "reconnecting"}</span>` : !robot.is_drivable && html`<span class="quiet">A recording cannot take a plan.</span>`}
    </div>
    <p class="wrong" role="alert">${wrong}</p>
    <h2>What the next ${horizon_s} s would look like</h2>
    <p class="quiet">Click one, and the robot takes it. Its cost is the difference between its last predicted frame and the goal, in gray levels, ± the error to expect.</p>
    <div class="plans">${(plans.length ? plans : PLANS.map(([name, , , color]) => ({ name, color, frames: [] }))).map((plan, place) => html`
      <button class=${`plan ${place === best && plans.length ? "best" : ""}`} aria-disabled=${!can_take} onClick=${() => can_take && take(plan)}>
        <h3><i style=${{ background: `var(${plan.color})` }} />${plan.name}${place === best && plans.length ? html` <span class="mark">best</span>` : ""}</h3>
        <${Picture} image=${plan.frames[step] ?? frame} label=${`predicted for ${plan.name}`} note=${plans.length ? "" : note} />
        <p>${plans.length ? html`cost <b>${levels(costs[place]).toFixed(1)}</b>${plan.expected === undefined ? "" : ` ±\u00a0${levels(plan.expected).toFixed(1)}`}` : "…"}</p>
      </button>`)}</div>
    <footer><${Copy} curl=${() => curl("POST", path(robot), requestFor(robot, robot.context), " -H 'Accept: image/gif' -o plans.gif")}
      python=${() => requests("POST", path(robot), requestFor(robot, robot.context), "for rollout in answer.json()[\"rollouts\"]:\n    print(len(rollout), \"frames\")")} /></footer>
  </section>`;
}

// Which predicted frame the tiles show; it rests on the last one.
function useAnimation(robot) {
  const [turn, setTurn] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => document.hidden || setTurn(now => now + 1), 1000 * robot.spec.frame_period_s);
    return () => clearInterval(timer);
  }, [robot]);
  return Math.min(turn % (robot.spec.horizon + 3), robot.spec.horizon - 1);
}

const RADIUS_M = 0.17;

// From above, the robot in the middle and its heading upwards. A circle every half metre.
function Ways({ robot, plans, best }) {
  const canvas = useRef();
  const metric = robot.spec.actions[0]?.unit === "m/s" && robot.spec.actions[1]?.unit === "rad/s";
  useEffect(() => {
    if (metric) drawMap(canvas.current, robot, plans, best);
  }, [plans, best, robot.now]);
  return html`<canvas class="map" ref=${canvas} width="360" height="360" role="img" aria-label=${metric ? "the ways of all plans from above" : "no map: the actions are not in metres"} />
    ${!metric && html`<span class="quiet">No map: the actions are not in metres.</span>`}`;
}

function drawMap(canvas, robot, plans, best) {
  const context = canvas.getContext("2d"), scale = canvas.width / 2, middle = [canvas.width / 2, canvas.height * 0.75];
  const color = name => getComputedStyle(canvas).getPropertyValue(name).trim();
  // x ahead and y left of the robot, in metres.
  const at = (x, y) => [middle[0] - y * scale, middle[1] - x * scale];
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.strokeStyle = color("--line");
  context.fillStyle = color("--quiet");
  // On a phone the map is shown smaller than it is drawn.
  const zoom = canvas.width / (canvas.clientWidth || canvas.width), bold = Math.sqrt(zoom);
  context.font = `${Math.round(13 * zoom)}px system-ui`;
  context.lineWidth = bold;
  for (const ring of [0.5, 1]) {
    context.beginPath();
    context.arc(...middle, ring * scale, 0, 2 * Math.PI);
    context.stroke();
    context.fillText(`${ring} m`, middle[0] + 4, middle[1] - ring * scale - 4);
  }
  const [own, ...others] = robot.now?.poses ?? [];
  for (const other of others) {
    const [dx, dy] = [other.x_m - own.x_m, other.y_m - own.y_m], [cos, sin] = [Math.cos(own.heading_rad), Math.sin(own.heading_rad)];
    disc(context, at(cos * dx + sin * dy, cos * dy - sin * dx), RADIUS_M * scale, color("--quiet"));
  }
  plans.forEach((plan, place) => {
    context.beginPath();
    context.moveTo(...at(0, 0));
    for (const [x, y] of wayOf(plan.actions, robot.spec.frame_period_s)) context.lineTo(...at(x, y));
    context.lineWidth = (place === best ? 6 : 3) * bold;
    context.lineCap = "round";
    context.strokeStyle = color(plan.color);
    context.stroke();
  });
  disc(context, middle, 8 * bold, color("--ink"));
}

function disc(context, [x, y], radius, fill) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = fill;
  context.fill();
}

// Places by the commands alone: the robot's wheels take a moment to follow.
function wayOf(actions, period_s) {
  let [x, y, heading] = [0, 0, 0];
  return actions.map(([speed, turn]) => {
    heading += turn * period_s;
    x += speed * Math.cos(heading) * period_s;
    y += speed * Math.sin(heading) * period_s;
    return [x, y];
  });
}
