// sensor_msgs/Image as pixels that a canvas takes.

export interface Image { width: number; height: number; encoding: string; is_bigendian: number | boolean; step: number; data: Uint8Array }

/** Where the colours of a pixel are, and how many bytes it has. */
const COLOURS: Record<string, { bytes: number; red: number; green: number; blue: number; alpha?: number }> = {
  rgb8: { bytes: 3, red: 0, green: 1, blue: 2 },
  bgr8: { bytes: 3, red: 2, green: 1, blue: 0 },
  '8UC3': { bytes: 3, red: 2, green: 1, blue: 0 },
  rgba8: { bytes: 4, red: 0, green: 1, blue: 2, alpha: 3 },
  bgra8: { bytes: 4, red: 2, green: 1, blue: 0, alpha: 3 },
  '8UC4': { bytes: 4, red: 2, green: 1, blue: 0, alpha: 3 },
  mono8: { bytes: 1, red: 0, green: 0, blue: 0 },
  '8UC1': { bytes: 1, red: 0, green: 0, blue: 0 },
};

export interface Drawn { pixels: ImageData; words: string }

/** Pixels and what to say of them. Throws an Error, in words, where it cannot be drawn. */
export function pixels(image: Image): Drawn {
  const { width, height, encoding, step, data } = image;
  const size = `${width} × ${height}, ${encoding}`;
  if (!width || !height) throw new Error(`the picture is empty: ${size}`);
  const bayer = /^bayer_....8$/.test(encoding);
  const layout = bayer ? COLOURS.mono8 : COLOURS[encoding];
  const deep = { mono16: 2, '16UC1': 2, '32FC1': 4 }[encoding];
  const bytes = layout?.bytes ?? deep;
  if (!bytes) throw new Error(`pictures of encoding ${encoding} are not drawn; their bytes are in the message below`);
  if (step < width * bytes || data.length < step * (height - 1) + width * bytes) throw new Error(`the picture holds ${data.length} bytes, too few for ${size} with ${step} bytes a row`);
  const drawn = new ImageData(width, height);
  if (layout) {
    plain(image, layout, drawn.data);
    return { pixels: drawn, words: bayer ? `${size}: the raw pattern of its filter` : size };
  }
  return { pixels: drawn, words: `${size}${scaled(image, bytes, drawn.data)}` };
}

function plain({ width, height, step, data }: Image, { bytes, red, green, blue, alpha }: NonNullable<(typeof COLOURS)[string]>, out: Uint8ClampedArray): void {
  let to = 0;
  for (let row = 0; row < height; row += 1) {
    for (let from = row * step, end = from + width * bytes; from < end; from += bytes, to += 4) {
      out[to] = data[from + red]!;
      out[to + 1] = data[from + green]!;
      out[to + 2] = data[from + blue]!;
      out[to + 3] = alpha === undefined ? 255 : data[from + alpha]!;
    }
  }
}

/** Greys from the least to the most; depths that are unknown (0 or not a number) are blue. Gives what to say of them. */
function scaled({ width, height, encoding, is_bigendian, step, data }: Image, bytes: number, out: Uint8ClampedArray): string {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const little = !is_bigendian;
  const value = encoding === '32FC1' ? (at: number) => view.getFloat32(at, little) : (at: number) => view.getUint16(at, little);
  const depth = encoding !== 'mono16';
  const known = (one: number) => !depth || (Number.isFinite(one) && one > 0);
  let [least, most] = depth ? [Infinity, -Infinity] : [0, 65535];
  const values = new Float32Array(width * height);
  for (let row = 0, to = 0; row < height; row += 1) {
    for (let column = 0; column < width; column += 1, to += 1) {
      const one = value(row * step + column * bytes);
      values[to] = one;
      if (depth && known(one)) {
        if (one < least) least = one;
        if (one > most) most = one;
      }
    }
  }
  const span = most > least ? most - least : 1;
  for (let index = 0, to = 0; index < values.length; index += 1, to += 4) {
    const one = values[index]!;
    const grey = known(one) ? ((one - least) / span) * 255 : 0;
    out[to] = grey;
    out[to + 1] = grey;
    out[to + 2] = known(one) ? grey : 160;
    out[to + 3] = 255;
  }
  if (!depth) return '';
  if (most < least) return ': no valid depth';
  const metres = (one: number) => (encoding === '16UC1' ? one / 1000 : one).toFixed(2);
  return `: depths of ${metres(least)} m (black) to ${metres(most)} m (white); blue: unknown`;
}

/** Whether its data are a JPEG of the pixels, as previews are, in place of the pixels. */
export const isPreview = ({ step, height, data }: Image) => data[0] === 0xff && data[1] === 0xd8 && data.length < step * height;

/** The media type of a sensor_msgs/CompressedImage, by how its bytes begin. Throws an Error in words where a browser cannot show it. */
export function media(format: string, data: Uint8Array): string {
  if (data[0] === 0xff && data[1] === 0xd8) return 'image/jpeg';
  if (data[0] === 0x89 && data[1] === 0x50) return 'image/png';
  if (data[0] === 0x52 && data[1] === 0x49 && data[8] === 0x57) return 'image/webp';
  throw new Error(`compressed pictures of format ${JSON.stringify(format)} are not drawn; JPEG, PNG and WebP are`);
}
