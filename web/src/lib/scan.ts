// sensor_msgs/LaserScan, seen from above: ahead is up, left is left (REP 103).

export interface Scan { header: { frame_id: string }; angle_min: number; angle_max: number; angle_increment: number; range_min: number; range_max: number; ranges: ArrayLike<number | null> }

/** What is in range, as x (ahead) and y (left) in metres, one after the other. */
export function points({ angle_min, angle_increment, range_min, range_max, ranges }: Scan): Float32Array {
  const found = new Float32Array(ranges.length * 2);
  let count = 0;
  for (let index = 0; index < ranges.length; index += 1) {
    const range = ranges[index];
    if (range == null || !(range >= range_min && range <= range_max)) continue;
    const angle = angle_min + index * angle_increment;
    found[count] = range * Math.cos(angle);
    found[count + 1] = range * Math.sin(angle);
    count += 2;
  }
  return found.subarray(0, count);
}

/** A distance between rings that gives three to eight of them within so many metres. */
export function ring(reach: number): number {
  const power = 10 ** Math.floor(Math.log10(reach || 1));
  return [0.2, 0.5, 1, 2].map((step) => step * power).find((step) => reach / step <= 8) ?? power;
}
