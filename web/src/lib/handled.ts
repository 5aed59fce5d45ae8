// A view that is moved and zoomed: by pointer, wheel, two fingers, and keys.

export interface Handles {
  /** Moved by so many pixels of the canvas. */
  moves: (right: number, down: number) => void;
  /** Zoomed by so much. */
  zooms: (factor: number) => void;
}

const STEP = 30;
const KEYS: Record<string, (handles: Handles) => void> = {
  ArrowLeft: ({ moves }) => moves(STEP, 0),
  ArrowRight: ({ moves }) => moves(-STEP, 0),
  ArrowUp: ({ moves }) => moves(0, STEP),
  ArrowDown: ({ moves }) => moves(0, -STEP),
  '+': ({ zooms }) => zooms(1.25),
  '=': ({ zooms }) => zooms(1.25),
  '-': ({ zooms }) => zooms(0.8),
};

/** For `use:handled` on a canvas. */
export function handled(canvas: HTMLCanvasElement, handles: Handles) {
  const fingers = new Map<number, PointerEvent>();
  // The canvas may be shown smaller than it is.
  const ratio = () => canvas.width / (canvas.clientWidth || canvas.width);
  const apart = () => {
    const [one, other] = [...fingers.values()];
    return one && other ? Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) : 0;
  };
  const down = (event: PointerEvent) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
  };
  const move = (event: PointerEvent) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const was = apart();
    fingers.set(event.pointerId, event);
    if (fingers.size === 2 && was > 0) handles.zooms(apart() / was);
    else if (fingers.size === 1) handles.moves((event.clientX - before.clientX) * ratio(), (event.clientY - before.clientY) * ratio());
  };
  const up = (event: PointerEvent) => fingers.delete(event.pointerId);
  const wheel = (event: WheelEvent) => {
    // The page is scrolled unless the view is what somebody is at.
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    handles.zooms(event.deltaY < 0 ? 1.15 : 1 / 1.15);
  };
  const key = (event: KeyboardEvent) => {
    const does = KEYS[event.key];
    if (!does || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    does(handles);
  };
  canvas.addEventListener('pointerdown', down);
  canvas.addEventListener('pointermove', move);
  canvas.addEventListener('pointerup', up);
  canvas.addEventListener('pointercancel', up);
  canvas.addEventListener('wheel', wheel, { passive: false });
  canvas.addEventListener('keydown', key);
  return {
    update(next: Handles) { handles = next; },
  };
}
