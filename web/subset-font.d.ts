/** What this build uses of subset-font; its published types are those of an older version. */
declare module 'subset-font' {
  export default function subsetFont(
    font: Buffer,
    text: string,
    options: { targetFormat: 'woff2'; keepFeatures: readonly string[]; variationAxes: Record<string, { min: number; max: number }> },
  ): Promise<Buffer>;
}
