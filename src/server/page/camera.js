// The camera of a robot: what it would see if the robot only turned.

import { Gray } from "./gray.js";

// The camera of the simulated robot, unless the model names another one.
export const SIMULATOR_CAMERA = { height_m: 0.6, horizontal_fov_rad: Math.PI / 3, tilt_down_rad: 0.2, noise_std: 1 / 255 };

// The camera of a model's frames; undefined where it is not known: for recordings of robots.
export const cameraOf = ({ spec, lineage }) => spec.camera ?? (lineage.scenario ? SIMULATOR_CAMERA : undefined);

// The image after the camera turned about the vertical, counter-clockwise; at its edges, the nearest pixels are repeated. The same
// geometry as in the server: a pinhole with square pixels, tilted down.
export function turned(image, { horizontal_fov_rad, tilt_down_rad }, yaw_rad) {
  const { width, height, pixels } = image;
  const made = new Uint8Array(pixels.length);
  const pixel_size = (2 * Math.tan(horizontal_fov_rad / 2)) / width;
  const [tilt_cos, tilt_sin, yaw_cos, yaw_sin] = [Math.cos(tilt_down_rad), Math.sin(tilt_down_rad), Math.cos(yaw_rad), Math.sin(yaw_rad)];
  for (let row = 0; row < height; row++) {
    for (let column = 0; column < width; column++) {
      // The pixel's ray in the robot's axes after the turn, then in those before it, then its place in the image before.
      const right = (column + 0.5 - width / 2) * pixel_size, below = (row + 0.5 - height / 2) * pixel_size;
      const ahead = tilt_cos - below * tilt_sin, up = -tilt_sin - below * tilt_cos;
      const ahead_before = yaw_cos * ahead + yaw_sin * right, left_before = yaw_sin * ahead - yaw_cos * right;
      const depth = Math.max(1e-3, tilt_cos * ahead_before - tilt_sin * up), down = -tilt_sin * ahead_before - tilt_cos * up;
      const x = width / 2 - left_before / depth / pixel_size, y = height / 2 + down / depth / pixel_size;
      made[row * width + column] = sample(pixels, width, height, x - 0.5, y - 0.5);
    }
  }
  return new Gray(width, height, made);
}

// The mean of the four pixels around a place, the nearer the heavier.
function sample(pixels, width, height, x, y) {
  x = Math.min(Math.max(x, 0), width - 1);
  y = Math.min(Math.max(y, 0), height - 1);
  const left = Math.floor(x), top = Math.floor(y), right = Math.min(left + 1, width - 1), bottom = Math.min(top + 1, height - 1);
  const mix = (one, other, share) => one + share * (other - one);
  const along = row => mix(pixels[row * width + left], pixels[row * width + right], x - left);
  return Math.round(mix(along(top), along(bottom), y - top));
}
