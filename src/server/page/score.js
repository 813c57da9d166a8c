// How good a prediction was, in numbers and in words.

import { mean, mse } from "./gray.js";

// Below this, nothing moves and the camera's noise decides: 1.5 gray levels.
const STILL_MSE = (1.5 / 255) ** 2;
// Moments over which errors are averaged: single frames jump.
const AVERAGED = 15;
// Above it, a prediction is not to be trusted; above the lower one, take care.
export const NOVEL = 0.99;
export const RAISED = 0.9;

export const levels = error => 255 * Math.sqrt(error);

// Compares a moment with what was predicted for it `horizon` frames ago, if its context reaches back so far. `history` ends with it.
export function compare(history, { horizon, context }) {
  const now = history.at(-1), then = history.at(-1 - horizon);
  const since = history.slice(-horizon);
  if (!then?.prediction || since.some(({ begins }) => begins)) return {};
  const predicted = then.prediction.frames[horizon - 1];
  const seen = history.slice(-horizon - context, -horizon).map(({ frame }) => frame);
  return {
    predicted,
    error: mse(predicted, now.frame),
    guess_error: Math.min(mse(then.frame, now.frame), mse(mean(seen), now.frame)),
    expected: then.prediction.expected_mse?.[horizon - 1],
    band: then.prediction.mse_band_90?.[horizon - 1],
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
