// How good a prediction was, in numbers and in words.

import { turned } from "./camera.js";
import { mean, mse } from "./gray.js";

// Below this, nothing moves and the camera's noise decides: 1.5 gray levels.
const STILL_MSE = (1.5 / 255) ** 2;
// Moments over which errors are averaged: single frames jump.
export const AVERAGED = 15;
// Above NOVEL, a prediction is not to be trusted; above RAISED, take care.
export const NOVEL = 0.99;
const RAISED = 0.9;

export const levels = error => 255 * Math.sqrt(error);

// The context of `horizon` frames ago, if all frames since are of one episode; null otherwise.
export function lookBack(moments, { horizon, context }) {
  const all = moments.slice(-horizon - context);
  if (all.length < horizon + context || all.slice(1).some(({ begins }) => begins)) return null;
  return all.slice(0, context);
}

// What needs no model. The skill of a model is measured against stronger baselines besides: these are those that a page can compute. Play says in full what they are.
export const GUESSES = { copy: "a copy", mean: "the mean frame", turned: "a turned copy" };

// Compares the last moment with what was predicted for it from the context of `horizon` frames ago. `camera` may be unknown.
export function compare(moment, seen, { frames, expected_mse, mse_band_90 }, { states }, camera) {
  const { frame } = moment, predicted = frames.at(-1), last = seen.at(-1);
  const yaw_rad = camera && turnBetween(last.state, moment.state, states);
  return {
    predicted,
    error: mse(predicted, frame),
    guess_errors: {
      copy: mse(last.frame, frame),
      mean: mse(mean(seen.map(one => one.frame)), frame),
      ...(yaw_rad && { turned: mse(turned(last.frame, camera, yaw_rad), frame) }),
    },
    expected: expected_mse?.at(-1),
    band: mse_band_90?.at(-1),
  };
}

// How far the robot turned between two states, in radians, counter-clockwise; undefined if they do not tell.
function turnBetween(before, after, channels) {
  const [cos, sin] = ["heading_cos", "heading_sin"].map(name => channels.findIndex(channel => channel.name === name));
  if (cos < 0 || sin < 0 || before?.length !== channels.length || after?.length !== channels.length) return undefined;
  return Math.atan2(after[sin] * before[cos] - after[cos] * before[sin], after[cos] * before[cos] + after[sin] * before[sin]);
}

const average = values => values.reduce((sum, value) => sum + value, 0) / values.length;

export const compared = moments => moments.filter(({ error }) => error !== undefined);
// Without a turn, a turned copy is a copy.
export const guessError = ({ guess_errors }, name) => guess_errors[name] ?? guess_errors.copy;

// Which simple guess has the least error over these moments.
export function bestGuess(moments) {
  const errorOf = name => average(compared(moments).map(moment => guessError(moment, name)));
  return Object.keys(GUESSES).reduce((one, other) => (errorOf(other) < errorOf(one) ? other : one));
}

// The error of the last moments as a share of that of the best simple guess, and which guess that is; null while there is none, and
// `is_still` where nothing moves, so that the share would compare noise.
export function share(history) {
  const last = compared(history.slice(-AVERAGED));
  if (!last.length) return null;
  const best = bestGuess(last);
  const [error, guess] = [average(last.map(moment => moment.error)), average(last.map(moment => guessError(moment, best)))];
  return { error, best: GUESSES[best], is_still: guess < STILL_MSE, of_guess: error / guess };
}

// The middle of the last novelties: single frames jump.
export function novelty(history) {
  const last = history.slice(-5).map(({ prediction }) => prediction?.novelty).filter(value => value !== undefined);
  return last.length ? last.sort((one, other) => one - other)[last.length >> 1] : null;
}

export const noveltyWord = value => (value > NOVEL ? "very high" : value > RAISED ? "raised" : "low");
export const noveltyClass = value => (value > NOVEL ? "bad" : value > RAISED ? "care" : "good");
