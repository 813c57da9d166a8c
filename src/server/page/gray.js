// Gray images: decoded, drawn and compared.

import { fromBytes, toBytes } from "./base64.js";

// An image; pixels are bytes, row by row.
export class Gray {
  constructor(width, height, pixels) {
    Object.assign(this, { width, height, pixels });
  }
}

// The pixels as base64; written once, since a frame is sent several times.
export const raw = image => (image.base64 ??= fromBytes(image.pixels));

const scratch = new OffscreenCanvas(1, 1);
const scratchContext = scratch.getContext("2d", { willReadFrequently: true });

export async function fromPng(base64) {
  const image = await createImageBitmap(new Blob([toBytes(base64)], { type: "image/png" }), { colorSpaceConversion: "none" });
  // No other image is decoded between here and the return.
  const { width, height } = image;
  if (scratch.width < width || scratch.height < height) Object.assign(scratch, { width, height });
  scratchContext.drawImage(image, 0, 0);
  image.close();
  const { data } = scratchContext.getImageData(0, 0, width, height), pixels = new Uint8Array(width * height);
  for (let index = 0; index < pixels.length; index++) pixels[index] = data[4 * index];
  return new Gray(width, height, pixels);
}

// The mean squared difference; intensities 0 to 1.
export function mse(one, other) {
  let sum = 0;
  for (let index = 0; index < one.pixels.length; index++) sum += (one.pixels[index] - other.pixels[index]) ** 2;
  return sum / one.pixels.length / 65025;
}

export function mean(images) {
  const [{ width, height }] = images;
  const sums = new Float32Array(width * height);
  for (const { pixels } of images) for (let index = 0; index < sums.length; index++) sums[index] += pixels[index];
  return new Gray(width, height, Uint8Array.from(sums.map(sum => sum / images.length)));
}

// Draws an image, or with `other` the difference to it: orange where the first is brighter, blue where it is darker.
export function draw(canvas, image, other) {
  const { width, height, pixels } = image;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  const picture = context.createImageData(width, height);
  const words = new Uint32Array(picture.data.buffer);
  for (let index = 0; index < words.length; index++) {
    words[index] = other ? differenceColor(pixels[index] - other.pixels[index]) : 0xff000000 | (pixels[index] * 0x010101);
  }
  context.putImageData(picture, 0, 0);
}

// Alpha, blue, green, red. A difference of 64 of 255 has the full color.
function differenceColor(difference) {
  const alpha = Math.min(255, Math.abs(difference) * 4);
  return ((alpha << 24) | (difference > 0 ? 0x1e8ae0 : 0xe07a1e)) >>> 0;
}
