// A message as a form: what its definition has, field by field, as rosapi tells it.

/** rosapi/TypeDef. Of a field's length -1 is one value, 0 any number of them. */
export interface Definition {
  type: string;
  fieldnames: string[];
  fieldtypes: string[];
  fieldarraylen: number[];
  examples: string[];
  constnames?: string[];
  constvalues?: string[];
}

/** Names that rosapi of ROS 2 takes from IDL, and those of message definitions. Moments are messages there; the daemon reads either form of them. */
const OF_IDL: { [name: string]: string } = {
  boolean: 'bool', octet: 'byte', float: 'float32', double: 'float64', wstring: 'string',
  'builtin_interfaces/Time': 'time', 'builtin_interfaces/Duration': 'duration',
};

/** Definitions whose fields have the names of message definitions, whichever ROS they come from. */
export const plain = (definitions: Definition[]): Definition[] =>
  definitions.map((one) => ({ ...one, fieldtypes: one.fieldtypes.map((type) => OF_IDL[type] ?? type) }));

/** The name of a message type without what ROS 2 has between package and name. */
export const bare = (type: string) => type.replace('/msg/', '/');

export type Value = unknown;
export type Parts = { [name: string]: Value };

export interface FieldOf { name: string; type: string; length: number }

const PLAIN: Parts = { string: '', bool: false };
const MOMENT = { secs: 0, nsecs: 0 };
/** Numbers that a browser holds exactly go no further. */
const EXACT = Number.MAX_SAFE_INTEGER;
const WHOLE: { [type: string]: [least: number, most: number] } = {
  int8: [-128, 127], byte: [-128, 127], uint8: [0, 255], char: [0, 255], int16: [-32768, 32767], uint16: [0, 65535],
  int32: [-(2 ** 31), 2 ** 31 - 1], uint32: [0, 2 ** 32 - 1], int64: [-EXACT, EXACT], uint64: [0, EXACT],
};

/** Least and most of a whole number; undefined for other types. */
export const bounds = (type: string): [number, number] | undefined => WHOLE[type];
export const isNumber = (type: string) => type in WHOLE || type === 'float32' || type === 'float64';
export const isMoment = (type: string) => type === 'time' || type === 'duration';
/** Lists of bytes, which are base64 in JSON. */
export const isBytes = ({ type, length }: FieldOf) => length !== -1 && (type === 'uint8' || type === 'char');

const own = (definitions: Definition[], type: string) => (isMoment(type) ? undefined : definitions.find((one) => one.type === type));

/** Fields of a type; none where it is plain. */
export function fields(definitions: Definition[], type: string): FieldOf[] {
  const found = own(definitions, type);
  return found?.fieldnames.map((name, index) => ({ name, type: found.fieldtypes[index] ?? '', length: found.fieldarraylen[index] ?? -1 })) ?? [];
}

export const isMessage = (definitions: Definition[], type: string) => own(definitions, type) !== undefined;

/** Named values of a type, such as those of an enumeration. */
export function constants(definitions: Definition[], type: string): [name: string, value: string][] {
  const found = own(definitions, type);
  return found?.constnames?.map((name, index) => [name, found.constvalues?.[index] ?? '']) ?? [];
}

/** One value with nothing in it. */
export function one(definitions: Definition[], type: string): Value {
  if (isMoment(type)) return { ...MOMENT };
  if (!isMessage(definitions, type)) return PLAIN[type] ?? 0;
  return Object.fromEntries(fields(definitions, type).map((field) => [field.name, empty(definitions, field)]));
}

/** What a field holds at first. */
export function empty(definitions: Definition[], { type, length }: FieldOf): Value {
  return length === -1 ? one(definitions, type) : Array.from({ length }, () => one(definitions, type));
}

/** A message with nothing in it, of definitions as rosapi gives them: the first is its own. */
export const blank = (definitions: Definition[]): Value => one(definitions, definitions[0]?.type ?? '');

/** Bytes as people write them: numbers, or base64 as it stands in JSON. What is neither is said in words. */
export function bytes(text: string, length: number): { value?: number[] | string; count?: number; wrong?: string } {
  const parts = text.split(/[\s,]+/).filter(Boolean);
  let found: number[] | string = parts.map((part) => (/^(\d{1,3}|0x[\da-f]{1,2})$/i.test(part) ? Number(part) : NaN));
  let count = found.length;
  if (found.some((byte) => !(byte <= 255))) {
    found = text.trim();
    if (!/^[A-Za-z0-9+/]+={0,2}$/.test(found) || found.length % 4 === 1) return { wrong: 'write numbers from 0 to 255 separated by spaces, or base64' };
    count = Math.floor((found.replace(/=+$/, '').length * 3) / 4);
  }
  if (length > 0 && count !== length) return { wrong: `it must have ${length} bytes, not ${count}` };
  return { value: found, count };
}

/** How many bytes a value has. */
export function byteCount(value: Value): number {
  if (typeof value === 'string') return Math.floor((value.replace(/=+$/, '').length * 3) / 4);
  return Array.isArray(value) ? value.length : 0;
}
