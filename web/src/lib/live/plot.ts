import uPlot from 'uplot';
import 'uplot/dist/uPlot.min.css';
import type { GaugeSpec } from './gauges';
import type { History } from './history';

const LEAST_PX = 16;

interface Colors {
  line: string;
  limit: string;
  beyond: string;
}

function readColors(): Colors {
  const style = getComputedStyle(document.documentElement);
  const token = (name: string): string => style.getPropertyValue(name).trim();
  return { line: token('--t1'), limit: token('--danger'), beyond: token('--danger-tint') };
}

/** A small plot of one gauge: the last seconds, the limit dashed, what lies beyond it shaded. */
export class Plot {
  private readonly plot: uPlot;
  private readonly watch: ResizeObserver;
  private readonly colors = readColors();
  private limit: number | null = null;
  private beyond = false;
  private top: number;
  private nowS = 0;

  constructor(host: HTMLElement, private readonly spec: GaugeSpec, private readonly windowS: number) {
    this.top = spec.span;
    const options: uPlot.Options = {
      width: Math.max(10, host.clientWidth),
      height: Math.max(LEAST_PX, host.clientHeight),
      padding: [4, 6, 4, 0],
      legend: { show: false },
      cursor: { show: false },
      axes: [{ show: false }, { show: false }],
      scales: {
        x: { time: false, range: () => [this.nowS - this.windowS, this.nowS] },
        y: { range: () => [0, this.top] },
      },
      series: [
        {},
        { stroke: () => (this.beyond ? this.colors.limit : this.colors.line), width: 1.5, points: { show: false }, spanGaps: false },
        { stroke: this.colors.limit, width: 1.25, dash: [4, 3], points: { show: false }, spanGaps: false },
      ],
      hooks: { drawClear: [(u) => this.shade(u)] },
    };
    this.plot = new uPlot(options, [[], [], []], host);
    this.watch = new ResizeObserver(() => this.plot.setSize({ width: Math.max(10, host.clientWidth), height: Math.max(LEAST_PX, host.clientHeight) }));
    this.watch.observe(host);
  }

  draw(history: History, beyond: boolean): void {
    this.beyond = beyond;
    this.limit = history.limits.at(-1) ?? null;
    this.nowS = history.times.at(-1) ?? 0;
    const known = [...history.values, this.limit].filter((value) => value !== null);
    this.top = Math.max(this.spec.span, 1.15 * Math.max(0, ...known));
    if (this.spec.key === 'separation') this.top = Math.min(this.top, 4);
    this.plot.setData([history.times, history.values, history.limits]);
  }

  end(): void {
    this.watch.disconnect();
    this.plot.destroy();
  }

  private shade(u: uPlot): void {
    if (this.limit === null || this.spec.side === 'none') return;
    const at = u.valToPos(this.limit, 'y', true);
    const { left, top, width, height } = u.bbox;
    u.ctx.fillStyle = this.colors.beyond;
    if (this.spec.side === 'most') u.ctx.fillRect(left, top, width, Math.max(0, at - top));
    else u.ctx.fillRect(left, at, width, Math.max(0, top + height - at));
  }
}
