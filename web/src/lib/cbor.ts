// Reads CBOR (RFC 8949) as the bridge writes it: typed arrays (RFC 8746) become typed arrays of JavaScript, bytes Uint8Array. What
// is within the message is not copied where its place in it allows that.

type Typed = new (buffer: ArrayBuffer, offset: number, length: number) => ArrayBufferView;

// Little-endian ones and those of bytes (RFC 8746, section 2.1); machines that run browsers are little-endian.
const TYPED: Record<number, [Typed, number]> = {
  64: [Uint8Array, 1], 68: [Uint8ClampedArray, 1], 69: [Uint16Array, 2], 70: [Uint32Array, 4], 71: [BigUint64Array, 8],
  72: [Int8Array, 1], 77: [Int16Array, 2], 78: [Int32Array, 4], 79: [BigInt64Array, 8], 85: [Float32Array, 4], 86: [Float64Array, 8],
};
const TEXT = new TextDecoder();
const DEEPEST = 200;

/** The value of one CBOR item. Throws an Error where it is none. */
export function decode(buffer: ArrayBuffer): unknown {
  const view = new DataView(buffer);
  let at = 0;

  function length(kind: number): number {
    if (kind < 24) return kind;
    at += [1, 2, 4, 8][kind - 24] ?? 0;
    switch (kind) {
      case 24: return view.getUint8(at - 1);
      case 25: return view.getUint16(at - 2);
      case 26: return view.getUint32(at - 4);
      case 27: return Number(view.getBigUint64(at - 8));
      default: throw new Error(`CBOR: length ${kind} at byte ${at} is not understood`);
    }
  }

  function bytes(count: number): Uint8Array {
    at += count;
    return new Uint8Array(buffer, at - count, count);
  }

  function half(bits: number): number {
    const [exponent, fraction] = [(bits >> 10) & 31, bits & 1023];
    const value = exponent === 31 ? (fraction ? NaN : Infinity) : exponent ? 2 ** (exponent - 25) * (1024 + fraction) : 2 ** -24 * fraction;
    return bits & 0x8000 ? -value : value;
  }

  function tagged(tag: number, depth: number): unknown {
    const value = item(depth + 1);
    const typed = TYPED[tag];
    if (!typed || !(value instanceof Uint8Array)) return value;
    const [Kind, size] = typed;
    const aligned = value.byteOffset % size === 0 ? value : value.slice();
    return new Kind(aligned.buffer as ArrayBuffer, aligned.byteOffset, Math.floor(value.byteLength / size));
  }

  function item(depth: number): unknown {
    if (depth > DEEPEST) throw new Error('CBOR: nested too deeply');
    const head = view.getUint8(at);
    at += 1;
    const [major, kind] = [head >> 5, head & 31];
    if (major === 7) {
      switch (kind) {
        case 20: return false;
        case 21: return true;
        case 22: return null;
        case 23: return undefined;
        case 25: at += 2; return half(view.getUint16(at - 2));
        case 26: at += 4; return view.getFloat32(at - 4);
        case 27: at += 8; return view.getFloat64(at - 8);
        default: throw new Error(`CBOR: value ${kind} at byte ${at} is not understood`);
      }
    }
    const count = length(kind);
    switch (major) {
      case 0: return count;
      case 1: return -1 - count;
      case 2: return bytes(count);
      case 3: return TEXT.decode(bytes(count));
      case 4: return Array.from({ length: count }, () => item(depth + 1));
      case 5: {
        const members: Record<string, unknown> = {};
        for (let member = 0; member < count; member += 1) {
          const key = String(item(depth + 1));
          members[key] = item(depth + 1);
        }
        return members;
      }
      default: return tagged(count, depth);
    }
  }

  return item(0);
}
