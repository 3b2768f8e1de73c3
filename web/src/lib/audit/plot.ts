import uPlot from 'uplot';
import 'uplot/dist/uPlot.min.css';

export interface Drawn {
  times: number[];
  values: (number | null)[];
  limits: (number | null)[] | null;
  /** Of the axis; it begins at 0, as the scale does. */
  length: number;
  top: number;
}

function token(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** One channel over a whole session: its values, and its limit dashed. */
export class TracePlot {
  private readonly plot: uPlot;
  private readonly watch: ResizeObserver;

  constructor(host: HTMLElement, drawn: Drawn, heightPx: number) {
    const series: uPlot.Series[] = [{}, { stroke: token('--t1'), width: 1.25, points: { show: false } }];
    if (drawn.limits !== null) series.push({ stroke: token('--danger'), width: 1.25, dash: [4, 3], points: { show: false } });
    const data = [drawn.times, drawn.values, ...(drawn.limits === null ? [] : [drawn.limits])] as uPlot.AlignedData;
    const width = (): number => Math.max(10, host.clientWidth);
    this.plot = new uPlot(
      {
        width: width(),
        height: heightPx,
        padding: [3, 0, 3, 0],
        legend: { show: false },
        cursor: { show: false },
        axes: [{ show: false }, { show: false }],
        scales: { x: { time: false, range: () => [0, drawn.length] }, y: { range: () => [0, drawn.top] } },
        series,
      },
      data,
      host,
    );
    this.watch = new ResizeObserver(() => this.plot.setSize({ width: width(), height: heightPx }));
    this.watch.observe(host);
  }

  end(): void {
    this.watch.disconnect();
    this.plot.destroy();
  }
}
