/** Names what an effect depends on without using it: the arguments were read, and that was the point. */
export function track(..._read: unknown[]): void {
  // nothing to do
}
