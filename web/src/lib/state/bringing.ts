/** A policy that is written in this tab, and outlives its page there: what it says of itself to whoever leaves the tab; null before one is looked at. */
export const bringing: { draft: { readonly leaving: string | null } | null } = { draft: null };
