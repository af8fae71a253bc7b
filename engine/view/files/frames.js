// Messages of the server, and frames in any memory layout.

/** The JSON of a binary message, and the bytes after it. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const about = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { about, pixels: new Uint8Array(buffer, 4 + length) };
}

/** Bytes of one environment's frame. */
export function frameBytes(frame) {
  return frame.width * frame.height * frame.channels;
}

/** The pixels of a frame, reused for the next one. */
let image;

/** Draws the frame that begins at byte `start`. `frame` holds the strides in bytes. */
export function paint(canvas, frame, pixels, start) {
  if (canvas.width !== frame.width) canvas.width = frame.width;
  if (canvas.height !== frame.height) canvas.height = frame.height;
  const context = canvas.getContext("2d");
  if (image?.width !== frame.width || image.height !== frame.height) image = context.createImageData(frame.width, frame.height);
  const green = frame.channels === 1 ? 0 : frame.channel;
  const blue = 2 * green;
  let to = 0;
  for (let y = 0; y < frame.height; y += 1) {
    let from = start + y * frame.y;
    for (let x = 0; x < frame.width; x += 1, from += frame.x, to += 4) {
      image.data[to] = pixels[from];
      image.data[to + 1] = pixels[from + green];
      image.data[to + 2] = pixels[from + blue];
      image.data[to + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
}
