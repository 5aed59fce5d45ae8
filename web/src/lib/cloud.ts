// sensor_msgs/PointCloud2: its points with their colours, and how they are seen.

interface Field { name: string; offset: number; datatype: number; count: number }
export interface Cloud { header: { frame_id: string }; width: number; height: number; fields: Field[]; is_bigendian: boolean; point_step: number; row_step: number; data: Uint8Array }

/** Points x, y, z in metres, and a colour (0xAABBGGRR) for each. */
export interface Points { places: Float32Array; colours: Uint32Array; count: number; all: number; by: string }

/** More are thinned to so many: more would not be told apart. */
const MOST = 60_000;
const SIZES = [0, 1, 1, 2, 2, 4, 4, 4, 8];

type Reads = (at: number) => number;

function reader(view: DataView, little: boolean, datatype: number): Reads | undefined {
  switch (datatype) {
    case 1: return (at) => view.getInt8(at);
    case 2: return (at) => view.getUint8(at);
    case 3: return (at) => view.getInt16(at, little);
    case 4: return (at) => view.getUint16(at, little);
    case 5: return (at) => view.getInt32(at, little);
    case 6: return (at) => view.getUint32(at, little);
    case 7: return (at) => view.getFloat32(at, little);
    case 8: return (at) => view.getFloat64(at, little);
    default: return undefined;
  }
}

/** Blue for the least, green between, red for the most. */
function warmth(share: number): number {
  const part = Math.min(Math.max(share, 0), 1);
  const [red, green, blue] = [Math.max(0, 2 * part - 1), 1 - Math.abs(2 * part - 1), Math.max(0, 1 - 2 * part)].map((one) => Math.round(40 + 215 * one));
  return (0xff000000 | (blue! << 16) | (green! << 8) | red!) >>> 0;
}

/** Its points, thinned where there are very many. Throws an Error in words where it has none that can be drawn. */
export function points(cloud: Cloud): Points {
  const { fields, point_step: step, row_step, width, height, data } = cloud;
  const named = (name: string) => fields.find((field) => field.name === name);
  const [x, y, z] = ['x', 'y', 'z'].map(named);
  if (!x || !y) throw new Error(`the cloud has no fields x and y: it has ${fields.map((field) => field.name).join(', ') || 'none'}`);
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const little = !cloud.is_bigendian;
  const reads = (field: Field | undefined) => field && reader(view, little, field.datatype);
  const [readX, readY, readZ] = [reads(x), reads(y), reads(z)];
  const beyond = fields.find((field) => field.offset + (SIZES[field.datatype] ?? 0) > step);
  if (!readX || !readY || beyond) throw new Error(`field ${(beyond ?? x).name} of the cloud lies beyond its points of ${step} bytes, or has an unknown type`);
  const rgb = named('rgb') ?? named('rgba');
  const intensity = named('intensity') ?? named('intensities');
  const shade = rgb ? undefined : (intensity ?? z);
  const readShade = reads(shade);
  const all = width * height;
  if (height > 0 && data.length < row_step * (height - 1) + step * width) throw new Error(`the cloud holds ${data.length} bytes, too few for ${all} points of ${step}`);
  const every = Math.max(1, Math.ceil(all / MOST));
  const places = new Float32Array(Math.ceil(all / every) * 3);
  const colours = new Uint32Array(Math.ceil(all / every));
  const shades = new Float32Array(shade ? colours.length : 0);
  let [count, least, most] = [0, Infinity, -Infinity];
  for (let index = 0; index < all; index += every) {
    const at = Math.floor(index / width) * row_step + (index % width) * step;
    const [px, py, pz] = [readX(at + x.offset), readY(at + y.offset), z && readZ ? readZ(at + z.offset) : 0];
    if (!Number.isFinite(px) || !Number.isFinite(py) || !Number.isFinite(pz)) continue;
    places.set([px, py, pz], count * 3);
    if (rgb) {
      // Packed as 0x00RRGGBB, whatever its type says.
      const packed = view.getUint32(at + rgb.offset, little);
      colours[count] = (0xff000000 | ((packed & 0xff) << 16) | (packed & 0xff00) | ((packed >> 16) & 0xff)) >>> 0;
    } else if (shade && readShade) {
      const one = readShade(at + shade.offset);
      shades[count] = one;
      if (one < least) least = one;
      if (one > most) most = one;
    }
    count += 1;
  }
  if (!rgb) for (let index = 0; index < count; index += 1) colours[index] = warmth(most > least ? (shades[index]! - least) / (most - least) : 0.5);
  const by = rgb ? 'in their colours' : shade ? `coloured by ${shade.name}, ${+least.toFixed(2)} (blue) to ${+most.toFixed(2)} (red)` : '';
  return { places: places.subarray(0, count * 3), colours, count, all, by };
}

/** How it is looked at: turned about z, tilted from above (0) to level (π/2), in radians; pixels for a metre. */
export interface Look { turn: number; tilt: number; scale: number; x: number; y: number }

/** From above, x to the right and y up, all of it in sight. */
export function fitted({ places, count }: Points, width: number, height: number): Look {
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (let index = 0; index < count * 3; index += 3) {
    left = Math.min(left, places[index]!);
    right = Math.max(right, places[index]!);
    low = Math.min(low, places[index + 1]!);
    high = Math.max(high, places[index + 1]!);
  }
  if (!count) return { turn: 0, tilt: 0, scale: 50, x: 0, y: 0 };
  return { turn: 0, tilt: 0, scale: 0.9 * Math.min(width / Math.max(right - left, 0.1), height / Math.max(high - low, 0.1)), x: (left + right) / 2, y: (low + high) / 2 };
}

/** Draws the points without perspective; the nearer one is in front. */
export function draw({ places, colours, count }: Points, look: Look, onto: ImageData): void {
  const { width, height } = onto;
  const out = new Uint32Array(onto.data.buffer);
  out.fill(0);
  const depths = new Float32Array(width * height).fill(-Infinity);
  const [cosTurn, sinTurn, cosTilt, sinTilt] = [Math.cos(look.turn), Math.sin(look.turn), Math.cos(look.tilt), Math.sin(look.tilt)];
  for (let index = 0; index < count; index += 1) {
    const [px, py, pz] = [places[index * 3]! - look.x, places[index * 3 + 1]! - look.y, places[index * 3 + 2]!];
    const across = px * cosTurn - py * sinTurn;
    const along = px * sinTurn + py * cosTurn;
    const column = Math.round(width / 2 + across * look.scale);
    const row = Math.round(height / 2 - (along * cosTilt + pz * sinTilt) * look.scale);
    const depth = pz * cosTilt - along * sinTilt;
    // Two pixels each way: one is hard to see.
    for (let at = 0; at < 4; at += 1) {
      const [tox, toy] = [column + (at & 1), row + (at >> 1)];
      if (tox < 0 || toy < 0 || tox >= width || toy >= height) continue;
      const to = toy * width + tox;
      if (depth < depths[to]!) continue;
      depths[to] = depth;
      out[to] = colours[index]!;
    }
  }
}
