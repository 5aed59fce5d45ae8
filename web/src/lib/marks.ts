// Events that the plots of a page mark.
import { getContext, setContext } from 'svelte';
import type { Event } from './types';

const KEY = Symbol('marks');

/** Called while a page is made: its plots mark these. */
export const setMarks = (events: () => Event[]): void => { setContext(KEY, events); };
/** Called while a plot is made. */
export const findMarks = (): (() => Event[]) => getContext<(() => Event[]) | undefined>(KEY) ?? (() => []);
