// How good a prediction was, in numbers and in words.

import { mean, mse } from "./gray.js";

// Below this, nothing moves and the camera's noise decides: 1.5 gray levels.
const STILL_MSE = (1.5 / 255) ** 2;
// Moments over which errors are averaged: single frames jump.
export const AVERAGED = 15;
// Above NOVEL, a prediction is not to be trusted; above RAISED, take care.
export const NOVEL = 0.99;
const RAISED = 0.9;

export const levels = error => 255 * Math.sqrt(error);

// The context of `horizon` frames ago and the actions since, if they are of one episode; null otherwise.
export function lookBack(moments, { horizon, context }) {
  const all = moments.slice(-horizon - context);
  if (all.length < horizon + context || all.slice(1).some(({ begins }) => begins)) return null;
  return { context: all.slice(0, context), plan: all.slice(context - 1, -1).map(({ action }) => action) };
}

// Compares the last moment with what was predicted for it from the context of `horizon` frames ago.
export function compare(frame, seen, { frames, expected_mse, mse_band_90 }) {
  const predicted = frames.at(-1), images = seen.map(moment => moment.frame);
  return {
    predicted,
    error: mse(predicted, frame),
    guess_error: Math.min(mse(images.at(-1), frame), mse(mean(images), frame)),
    expected: expected_mse?.at(-1),
    band: mse_band_90?.at(-1),
  };
}

const average = values => values.reduce((sum, value) => sum + value, 0) / values.length;

// The error of the last moments as a share of that of the best simple guess; null while there is none, and `is_still` where nothing
// moves, so that the share would compare noise.
export function share(history) {
  const compared = history.slice(-AVERAGED).filter(({ error }) => error !== undefined);
  if (!compared.length) return null;
  const [error, guess] = [average(compared.map(moment => moment.error)), average(compared.map(moment => moment.guess_error))];
  return { error, guess, is_still: guess < STILL_MSE, of_guess: error / guess };
}

// The middle of the last novelties: single frames jump.
export function novelty(history) {
  const last = history.slice(-5).map(({ prediction }) => prediction?.novelty).filter(value => value !== undefined);
  return last.length ? last.sort((one, other) => one - other)[last.length >> 1] : null;
}

export const noveltyWord = value => (value > NOVEL ? "very high" : value > RAISED ? "raised" : "low");
export const noveltyClass = value => (value > NOVEL ? "bad" : value > RAISED ? "care" : "good");
