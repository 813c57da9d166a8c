// Gray images as an animated GIF.

const CLEAR = 256;
const END = 257;

export function encodeGif(images, delay_ms) {
  const [{ width, height }] = images;
  const short = value => [value & 255, value >> 8];
  const parts = [Uint8Array.from([...text("GIF89a"), ...short(width), ...short(height), 0xf7, 0, 0]), grays(),
    Uint8Array.from([0x21, 0xff, 11, ...text("NETSCAPE2.0"), 3, 1, 0, 0, 0])];
  const delay = short(Math.max(2, Math.round(delay_ms / 10)));
  for (const image of images) {
    parts.push(Uint8Array.from([0x21, 0xf9, 4, 0, ...delay, 0, 0, 0x2c, 0, 0, 0, 0, ...short(width), ...short(height), 0, 8]));
    parts.push(...compress(image.pixels), Uint8Array.of(0));
  }
  return new Blob([...parts, Uint8Array.of(0x3b)], { type: "image/gif" });
}

const text = letters => [...letters].map(letter => letter.charCodeAt(0));
const grays = () => Uint8Array.from({ length: 768 }, (_, index) => Math.floor(index / 3));

// For each string (its code and the byte after it) the code, with the number of the dictionary in the upper bits: an older entry
// does not count, so that a new dictionary need not clear the table.
const table = new Uint32Array(4096 * 256);
let dictionary = 0;

// LZW with codes of 9 to 12 bits, in blocks of at most 255 bytes.
function compress(pixels) {
  const bytes = new Uint8Array(Math.ceil(pixels.length * 1.6) + 16);
  let count = 0, held = 0, held_bits = 0, width = 9, next = END + 1;
  const write = code => {
    held |= code << held_bits;
    for (held_bits += width; held_bits >= 8; held_bits -= 8, held >>>= 8) bytes[count++] = held & 255;
  };
  const begin = () => {
    write(CLEAR);
    [width, next, dictionary] = [9, END + 1, (dictionary + 1) % (1 << 20)];
    if (dictionary === 0) table.fill(0);
  };
  begin();
  let prefix = pixels[0];
  for (let index = 1; index < pixels.length; index++) {
    const place = (prefix << 8) | pixels[index], entry = table[place];
    if (entry >>> 12 === dictionary && entry) {
      prefix = entry & 4095;
      continue;
    }
    write(prefix);
    if (next === 4096) begin();
    else {
      table[place] = ((dictionary << 12) | next) >>> 0;
      if (next === 1 << width) width++;
      next++;
    }
    prefix = pixels[index];
  }
  write(prefix);
  write(END);
  if (held_bits) bytes[count++] = held & 255;
  const blocks = [];
  for (let at = 0; at < count; at += 255) {
    const block = bytes.subarray(at, Math.min(at + 255, count));
    blocks.push(Uint8Array.of(block.length), block);
  }
  return blocks;
}
