// Colours that programs print (ECMA-48, SGR): the eight as classes of the style sheet, others as values that can be read in both themes.

export interface Piece {
  text: string;
  /** Classes. */
  style: string;
  /** CSS values, where classes do not say it. */
  colour?: string;
  ground?: string;
}

export type Colour = readonly [red: number, green: number, blue: number];

const NAMES = ['black', 'red', 'green', 'yellow', 'blue', 'magenta', 'cyan', 'white'];
/** As xterm has them: the eight, and the bright ones. */
const SIXTEEN: Colour[] = [
  [0, 0, 0], [205, 0, 0], [0, 205, 0], [205, 205, 0], [0, 0, 238], [205, 0, 205], [0, 205, 205], [229, 229, 229],
  [127, 127, 127], [255, 0, 0], [0, 255, 0], [255, 255, 0], [92, 92, 255], [255, 0, 255], [0, 255, 255], [255, 255, 255],
];
/** `--ground` and `--ink` of app.css: light, dark. */
const GROUND: [Colour, Colour] = [[244, 245, 248], [13, 17, 22]];
const INK: [Colour, Colour] = [[22, 32, 43], [230, 235, 241]];
/** Of WCAG 2, for text (AA). */
const CONTRAST = 4.5;

/** One of the 256: sixteen, a cube of six steps, greys. */
export function palette(index: number): Colour {
  if (index < 16) return SIXTEEN[index]!;
  if (index >= 232) {
    const grey = 8 + (index - 232) * 10;
    return [grey, grey, grey];
  }
  const step = (of: number) => (of ? 55 + of * 40 : 0);
  const at = index - 16;
  return [step(Math.floor(at / 36)), step(Math.floor(at / 6) % 6), step(at % 6)];
}

function luminance(colour: Colour): number {
  const [red, green, blue] = colour.map((part) => (part <= 10 ? part / 3294 : ((part / 255 + 0.055) / 1.055) ** 2.4)) as [number, number, number];
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
}

export function contrast(one: Colour, other: Colour): number {
  const [dark, bright] = [luminance(one), luminance(other)].sort((a, b) => a - b) as [number, number];
  return (bright + 0.05) / (dark + 0.05);
}

/** The colour, or the nearest to it on the way to black or white that can be read there. */
export function readable(colour: Colour, on: Colour): Colour {
  const end = contrast([0, 0, 0], on) > contrast([255, 255, 255], on) ? 0 : 255;
  let now = colour;
  for (let part = 1; contrast(now, on) < CONTRAST && part <= 20; part += 1) {
    now = colour.map((of) => Math.round(of + ((end - of) * part) / 20)) as unknown as Colour;
  }
  return now;
}

const css = (colour: Colour) => `rgb(${colour.join(' ')})`;
const both = (light: Colour, dark: Colour) => `light-dark(${css(light)}, ${css(dark)})`;

const FLAGS: { [code: number]: [flag: string, on: boolean][] } = {
  1: [['bold', true]], 2: [['faint', true]], 3: [['italic', true]], 4: [['underline', true]], 7: [['inverse', true]], 9: [['struck', true]], 21: [['underline', true]],
  22: [['bold', false], ['faint', false]], 23: [['italic', false]], 24: [['underline', false]], 27: [['inverse', false]], 29: [['struck', false]],
};

/** What is in force at some place of a line; a number is one of the sixteen. */
interface Style { flags: Set<string>; fore?: number | Colour; back?: number | Colour }

const of = (colour: number | Colour | undefined): Colour | undefined => (typeof colour === 'number' ? palette(colour) : colour);

function dressed(text: string, { flags, fore, back }: Style): Piece {
  const classes = [...flags].filter((flag) => flag !== 'inverse').map((flag) => `ansi-${flag}`);
  const inverse = flags.has('inverse');
  if (!inverse && back === undefined) {
    if (typeof fore === 'number' && fore < 8) classes.push(`ansi-${NAMES[fore]}`);
    const style = classes.join(' ');
    const own = of(fore);
    if (!own || (typeof fore === 'number' && fore < 8)) return { text, style };
    return { text, style, colour: both(readable(own, GROUND[0]), readable(own, GROUND[1])) };
  }
  const [ink, paper] = inverse ? [GROUND, INK] : [INK, GROUND];
  const [letters, ground] = (inverse ? [back, fore] : [fore, back]).map(of);
  const papers = paper.map((one) => ground ?? one) as [Colour, Colour];
  const inks = ink.map((one, theme) => readable(letters ?? one, papers[theme]!)) as [Colour, Colour];
  return { text, style: classes.join(' '), colour: both(...inks), ground: both(...papers) };
}

/** A colour by the numbers behind 38 or 48, and how many those are. */
function extended(codes: number[]): [colour: number | Colour | undefined, taken: number] {
  if (codes[0] === 5) {
    const index = codes[1] ?? 0;
    return [index < 16 ? index : index < 256 ? palette(index) : undefined, 2];
  }
  if (codes[0] !== 2) return [undefined, codes.length];
  const parts = codes.slice(1, 4).map((part) => Math.min(part, 255));
  return [parts.length === 3 ? (parts as unknown as Colour) : undefined, 4];
}

function turned(style: Style, sequence: string): void {
  const parts = (sequence || '0').split(';');
  for (let at = 0; at < parts.length; at += 1) {
    const [code = 0, ...more] = (parts[at] ?? '').split(':').map(Number);
    if (code === 0) [style.flags, style.fore, style.back] = [new Set(), undefined, undefined];
    // 4:0 is no underline, 4:3 a curly one.
    else if (code === 4 && more.length) style.flags[more[0] ? 'add' : 'delete']('underline');
    else if (code in FLAGS) for (const [flag, on] of FLAGS[code]!) style.flags[on ? 'add' : 'delete'](flag);
    else if (code === 39) style.fore = undefined;
    else if (code === 49) style.back = undefined;
    else if (code >= 30 && code <= 37) style.fore = code - 30;
    else if (code >= 40 && code <= 47) style.back = code - 40;
    else if (code >= 90 && code <= 97) style.fore = code - 82;
    else if (code >= 100 && code <= 107) style.back = code - 92;
    else if (code === 38 || code === 48) {
      // Behind colons there may be a colour space, which is left empty.
      const own = more.length ? (more[0] === 2 && more.length > 4 ? [2, ...more.slice(2)] : more) : parts.slice(at + 1).map(Number);
      const [colour, taken] = extended(own);
      if (!more.length) at += taken;
      style[code === 38 ? 'fore' : 'back'] = colour;
    }
  }
}

/** Pieces of a line, each of one style. Other control sequences are left out. */
export function pieces(line: string): Piece[] {
  const found: Piece[] = [];
  const style: Style = { flags: new Set() };
  const add = (text: string) => { if (text) found.push(dressed(text, style)); };
  let last = 0;
  // CSI with parameters and final byte; OSC, ended by BEL or ST; other escapes; other control characters.
  const sequences = /\x1b\[([\d;:?]*)([@-~])|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?|\x1b[@-_]?|[\x00-\x08\x0b-\x1a\x7f]/g;
  for (const match of line.matchAll(sequences)) {
    add(line.slice(last, match.index));
    last = match.index + match[0].length;
    if (match[2] === 'm') turned(style, match[1] ?? '');
  }
  add(line.slice(last));
  return found;
}
