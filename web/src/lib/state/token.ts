import { drive } from './drive.svelte';

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
  return sessionStorage.getItem(KEY);
}

/** Whoever signs in with another one has not the controls that were had before. */
export function keepToken(token: string): void {
  if (token !== sessionStorage.getItem(KEY)) drive.forget();
  sessionStorage.setItem(KEY, token);
}

export function dropToken(): void {
  sessionStorage.removeItem(KEY);
}

const LEFT = 'reins.left';

/** Keeps what whoever leaves the page has to know when it is loaded anew: whoever reloads is asked nothing. */
export function keepLeft(words: string | null): void {
  if (words === null) sessionStorage.removeItem(LEFT);
  else sessionStorage.setItem(LEFT, words);
}

export function takeLeft(): string | null {
  const words = sessionStorage.getItem(LEFT);
  keepLeft(null);
  return words;
}
