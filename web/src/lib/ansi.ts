// Colours that programs print (ECMA-48, SGR), as classes of the style sheet.

export interface Piece { text: string; style: string }

const COLOURS = ['black', 'red', 'green', 'yellow', 'blue', 'magenta', 'cyan', 'white'];

/** Pieces of a line, each of one style. Other control sequences are left out. */
export function pieces(line: string): Piece[] {
  const found: Piece[] = [];
  let bold = false;
  let faint = false;
  let colour = '';
  const add = (text: string) => {
    const style = [bold && 'ansi-bold', faint && 'ansi-faint', colour && `ansi-${colour}`].filter(Boolean).join(' ');
    if (text) found.push({ text, style });
  };
  let last = 0;
  // CSI with parameters and final byte; OSC, ended by BEL or ST; other escapes; other control characters.
  const sequences = /\x1b\[([\d;:?]*)([@-~])|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?|\x1b[@-_]?|[\x00-\x08\x0b-\x1a\x7f]/g;
  for (const match of line.matchAll(sequences)) {
    add(line.slice(last, match.index));
    last = match.index + match[0].length;
    if (match[2] !== 'm') continue;
    const codes = (match[1] || '0').split(/[;:]/).map(Number);
    for (let at = 0; at < codes.length; at += 1) {
      const code = codes[at] ?? 0;
      if (code === 0) [bold, faint, colour] = [false, false, ''];
      else if (code === 1) bold = true;
      else if (code === 2) faint = true;
      else if (code === 22) [bold, faint] = [false, false];
      else if (code === 39) colour = '';
      else if (code >= 30 && code <= 37) colour = COLOURS[code - 30] ?? '';
      else if (code >= 90 && code <= 97) colour = COLOURS[code - 90] ?? '';
      // Of the 256 and the 16 million, none is known here; what follows says which.
      else if (code === 38 || code === 48) at += codes[at + 1] === 5 ? 2 : 4;
    }
  }
  add(line.slice(last));
  return found;
}
