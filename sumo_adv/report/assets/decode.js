/** Bytes of base64 text, inflated. */
async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Reads columns of whole numbers in the order in which they were written; see encode.py. */
class Columns {
  constructor(bytes) { this.bytes = bytes; this.at = 0; }

  /** The next `count` numbers, of which differences were taken `order` times, times `unit`. */
  next(count, order, unit) {
    const out = new Float64Array(count);
    let value = 0, slope = 0;
    for (let i = 0; i < count; i++) {
      let raw = 0, factor = 1, byte;
      do { byte = this.bytes[this.at++]; raw += (byte & 127) * factor; factor *= 128; } while (byte > 127);
      const step = raw % 2 ? -(raw + 1) / 2 : raw / 2;
      if (order === 2) { slope += step; value += slope; } else value += step;
      out[i] = value * unit;
    }
    return out;
  }
}
