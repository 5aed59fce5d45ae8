// What plots draw with, and when they are drawn anew.
import type uPlot from 'uplot';

/** A colour of the style sheet. Those of both themes are written as one there; a canvas needs the one that holds now. */
export function colour(place: HTMLElement, name: string): string {
  const probe = place.appendChild(document.createElement('span'));
  probe.style.color = `var(${name})`;
  const { color } = getComputedStyle(probe);
  probe.remove();
  return color;
}

/** What both axes have in common. */
export function axis(place: HTMLElement): uPlot.Axis {
  const lines = { stroke: colour(place, '--line'), width: 1 };
  return { stroke: colour(place, '--faint'), font: `12px ${getComputedStyle(place).fontFamily}`, grid: lines, ticks: lines };
}

/** Calls `resize` with the width of a place as it changes, and `draw` when the theme does; gives what ends that. */
export function keepDrawn(place: HTMLElement, resize: (width: number) => void, draw: (width: number) => void): () => void {
  const resized = new ResizeObserver(([entry]) => {
    const width = Math.floor(entry?.contentRect.width ?? 0);
    if (width) resize(width);
  });
  resized.observe(place);
  const again = () => draw(place.clientWidth);
  const scheme = matchMedia('(prefers-color-scheme: dark)');
  scheme.addEventListener('change', again);
  const themed = new MutationObserver(again);
  themed.observe(document.documentElement, { attributeFilter: ['data-theme'] });
  return () => {
    resized.disconnect();
    scheme.removeEventListener('change', again);
    themed.disconnect();
  };
}
