// nav_msgs/OccupancyGrid as pixels, in the colours that maps of ROS have: free white, occupied black, unknown grey.

export interface Grid {
  header: { frame_id: string };
  info: { resolution: number; width: number; height: number; origin: { position: { x: number; y: number }; orientation: { z: number; w: number } } };
  data: ArrayLike<number>;
}

const UNKNOWN = 205;
const FREE = 254;

/** Its cells; the first row of a grid is its lowest. Throws an Error in words where it cannot be drawn. */
export function pixels({ info: { width, height }, data }: Grid): ImageData {
  if (!width || !height) throw new Error(`the grid is empty: ${width} × ${height} cells`);
  if (data.length < width * height) throw new Error(`the grid holds ${data.length} cells, too few for ${width} × ${height}`);
  const drawn = new ImageData(width, height);
  const out = drawn.data;
  for (let row = 0; row < height; row += 1) {
    let to = (height - 1 - row) * width * 4;
    for (let from = row * width, end = from + width; from < end; from += 1, to += 4) {
      const cell = data[from]!;
      const grey = cell < 0 || cell > 100 ? UNKNOWN : FREE - (FREE * cell) / 100;
      out[to] = grey;
      out[to + 1] = grey;
      out[to + 2] = grey;
      out[to + 3] = 255;
    }
  }
  return drawn;
}

const figure = (value: number) => String(+value.toFixed(3));

export function words({ header, info: { width, height, resolution, origin } }: Grid): string {
  const turned = (2 * Math.atan2(origin.orientation.z, origin.orientation.w) * 180) / Math.PI;
  const { x, y } = origin.position;
  return `${width} × ${height} cells of ${figure(resolution)} m: ${figure(width * resolution)} × ${figure(height * resolution)} m; origin (lower left) at ${figure(x)}, ${figure(y)} m${Math.abs(turned) > 0.05 ? `, rotated by ${figure(turned)}°` : ''} of ${header.frame_id || 'no frame'}`;
}
