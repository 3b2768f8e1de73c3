import { drive } from './drive.svelte';
import { tab } from './tab';

/** The operator's token: handed over in the fragment of the printed link, kept for this tab alone. */
const KEY = 'reins.token';

/** Returns the token of this tab. One in the fragment wins, and the address is cleaned of it before anything is sent. */
export function takeToken(): string | null {
  const fragment = new URLSearchParams(location.hash.slice(1));
  const handed = fragment.get('token');
  if (handed !== null) {
    history.replaceState(null, '', `${location.pathname}${location.search}#/live`);
    if (handed !== '') keepToken(handed);
  }
  return tab.read(KEY);
}

/** Whoever signs in with another one has not the controls that were had before. */
export function keepToken(token: string): void {
  if (token !== tab.read(KEY)) drive.forget();
  tab.write(KEY, token);
}

export function dropToken(): void {
  tab.drop(KEY);
}

const LEFT = 'reins.left';

/** Keeps what whoever leaves the page has to know when it is loaded anew: whoever reloads is asked nothing. */
export function keepLeft(words: string | null): void {
  if (words === null) tab.drop(LEFT);
  else tab.write(LEFT, words);
}

export function takeLeft(): string | null {
  const words = tab.read(LEFT);
  keepLeft(null);
  return words;
}
