import { Vector3, type Camera } from 'three';

/** A name that floats over the scene as an element of its own, so that it stays sharp and readable. */
export interface Label {
  text: string;
  at: Vector3;
  tone: 'plain' | 'accent' | 'warn' | 'danger';
  /** A figure that is read first stands in a box. */
  boxed?: boolean;
  /** What it must not hide: in a small picture it is left out. */
  clearOf?: Vector3;
}

/** Which names stand where several would cover each other. */
const WEIGHT: Record<Label['tone'], number> = { danger: 3, warn: 2, accent: 1, plain: 0 };
const LINE_PX = 15;
const LETTER_PX = 6.8;
const EDGE_PX = 6;
const BOX_PX = 12;
/** As much as a space beside a word: names that touch are read as one. */
const APART_PX = 8;

export interface Spot {
  x: number;
  y: number;
  half: number;
}

/** Where the middle of a name goes that is `half` wide to each side, so that it is not cut; null where its point is out of sight. */
export function within(x: number, half: number, width: number): number | null {
  if (x < 0 || x > width) return null;
  return 2 * half > width ? width / 2 : Math.min(Math.max(x, half), width - half);
}

/** Whether two names stand clear of each other. */
export function clear(a: Spot, b: Spot): boolean {
  return Math.abs(a.y - b.y) > LINE_PX || Math.abs(a.x - b.x) > a.half + b.half + APART_PX;
}

function onScreen(at: Vector3, camera: Camera, width: number, height: number): Vector3 {
  const { x, y, z } = at.clone().project(camera);
  return new Vector3(((x + 1) / 2) * width, ((1 - y) / 2) * height, z);
}

/** Whether a box hides what is at a point, or so much of what stands around it that it could not be told. */
export function hides({ x, y, half }: Spot, at: { x: number; y: number }): boolean {
  return Math.abs(at.x - x) < half + APART_PX && Math.abs(at.y - y) < LINE_PX + APART_PX;
}

/** Keeps one element per label, and puts each where its point is on the screen. */
export class Labels {
  private readonly elements = new Map<string, HTMLElement>();

  constructor(private readonly layer: HTMLElement) {}

  draw(labels: ReadonlyMap<string, Label>, camera: Camera, width: number, height: number): void {
    for (const [name, element] of this.elements) {
      if (labels.has(name)) continue;
      element.remove();
      this.elements.delete(name);
    }
    const taken: Spot[] = [];
    const graver = [...labels].sort(([, a], [, b]) => WEIGHT[b.tone] - WEIGHT[a.tone]);
    for (const [name, label] of graver) this.put(name, label, taken, camera, width, height);
  }

  clear(): void {
    this.elements.forEach((element) => element.remove());
    this.elements.clear();
  }

  private put(name: string, label: Label, taken: Spot[], camera: Camera, width: number, height: number): void {
    let element = this.elements.get(name);
    if (element === undefined) {
      element = document.createElement('span');
      this.layer.append(element);
      this.elements.set(name, element);
    }
    if (element.textContent !== label.text) element.textContent = label.text;
    element.dataset['tone'] = label.tone;
    element.classList.toggle('boxed', label.boxed === true);
    const at = onScreen(label.at, camera, width, height);
    const half = (label.text.length * LETTER_PX) / 2 + (label.boxed === true ? BOX_PX : 0);
    const x = within(at.x, half + EDGE_PX, width);
    const { y } = at;
    if (x === null) {
      element.hidden = true;
      return;
    }
    const spot: Spot = { x, y, half };
    // A name that would cover another is left out: two in one place are none.
    const free = taken.every((other) => clear(other, spot)) && !(label.clearOf !== undefined && hides(spot, onScreen(label.clearOf, camera, width, height)));
    element.hidden = at.z > 1 || !free;
    if (!element.hidden) taken.push(spot);
    element.style.transform = `translate(-50%, -50%) translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
  }
}
