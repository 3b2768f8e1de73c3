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

export function keepToken(token: string): void {
  sessionStorage.setItem(KEY, token);
}

export function dropToken(): void {
  sessionStorage.removeItem(KEY);
}
