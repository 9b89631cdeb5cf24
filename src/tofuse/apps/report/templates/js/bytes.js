// Arrays as `report/packing.py` packs them: differences of rows, in planes of bytes, deflated.
async function unpack(text, Kind, columns) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const out = new Kind(planes.length / Kind.BYTES_PER_ELEMENT);
  const size = Kind.BYTES_PER_ELEMENT, rows = out.length / columns;
  const words = size === 1 ? new Uint8Array(out.buffer) : size === 2 ? new Uint16Array(out.buffer) : new Uint32Array(out.buffer);
  for (let column = 0; column < columns; column++) {
    let sum = 0;
    for (let row = 0; row < rows; row++) {
      let step = 0;
      for (let byte = 0; byte < size; byte++) step |= planes[(column * size + byte) * rows + row] << (8 * byte);
      sum = (sum + step) | 0;
      words[row * columns + column] = sum;
    }
  }
  return out;
}
