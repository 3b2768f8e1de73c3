/** Pages live behind the fragment (`#/audit/inv_…`), so that the server needs to know one address only. */
export const PAGES = ['live', 'audit', 'policy', 'fleet'] as const;
export type Page = (typeof PAGES)[number];

export interface Route {
  page: Page;
  /** What stands behind the page's name: an invocation, a capability, a cell. */
  rest: string[];
}

export function readRoute(hash: string): Route {
  const [first, ...rest] = hash.replace(/^#\/?/, '').split('/').filter((part) => part !== '').map(decoded);
  const page = PAGES.find((name) => name === first);
  return page === undefined ? { page: 'live', rest: [] } : { page, rest };
}

export function hashOf(page: Page, ...rest: string[]): string {
  return `#/${[page, ...rest.map(encodeURIComponent)].join('/')}`;
}

function decoded(part: string): string {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

class Router {
  route = $state.raw<Route>(readRoute(location.hash));

  constructor() {
    addEventListener('hashchange', () => {
      this.route = readRoute(location.hash);
    });
  }

  go(page: Page, ...rest: string[]): void {
    location.hash = hashOf(page, ...rest);
  }

  /** Goes there without leaving a step to come back to. */
  replace(page: Page, ...rest: string[]): void {
    history.replaceState(null, '', hashOf(page, ...rest));
    this.route = readRoute(location.hash);
  }
}

export const router = new Router();
