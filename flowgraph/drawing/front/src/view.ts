// A drawing that is moved by dragging and arrows, and made larger by the wheel, two fingers or + and -.

export class View {
  x = 0; y = 0; zoom = 1;
  private fingers = new Map<number, { x: number; y: number }>();

  constructor(readonly frame: SVGSVGElement, readonly moved: SVGGElement) {
    frame.addEventListener("wheel", (event) => {
      event.preventDefault();
      const box = frame.getBoundingClientRect();
      this.scale(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), event.clientX - box.left, event.clientY - box.top);
    }, { passive: false });
    frame.addEventListener("pointerdown", (event) => {
      if (event.button === 0) this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    frame.addEventListener("pointermove", (event) => this.drag(event));
    for (const over of ["pointerup", "pointercancel", "pointerleave"] as const) {
      frame.addEventListener(over, (event) => {
        this.fingers.delete(event.pointerId);
        frame.classList.remove("dragged");
      });
    }
  }

  private drag(event: PointerEvent): void {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const others = [...this.fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const box = this.frame.getBoundingClientRect();
    if (others.length) {
      const [other] = others;
      const was = Math.hypot(before.x - other.x, before.y - other.y), is = Math.hypot(event.clientX - other.x, event.clientY - other.y);
      if (was > 0) this.scale(is / was, (event.clientX + other.x) / 2 - box.left, (event.clientY + other.y) / 2 - box.top);
    } else {
      if (!this.frame.classList.contains("dragged") && Math.hypot(event.clientX - before.x, event.clientY - before.y) < 4) return;
      this.frame.classList.add("dragged");
      this.move(event.clientX - before.x, event.clientY - before.y);
    }
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  move(dx: number, dy: number): void {
    this.x += dx;
    this.y += dy;
    this.show();
  }

  scale(by: number, x = this.frame.clientWidth / 2, y = this.frame.clientHeight / 2): void {
    const zoom = Math.min(Math.max(this.zoom * by, 0.08), 6);
    this.x = x - ((x - this.x) * zoom) / this.zoom;
    this.y = y - ((y - this.y) * zoom) / this.zoom;
    this.zoom = zoom;
    this.show();
  }

  /** All of a drawing of this size if its text stays readable, else its upper left part. */
  fit(width: number, height: number, least: number): void {
    const room = { width: this.frame.clientWidth - 24, height: this.frame.clientHeight - 24 };
    const whole = Math.min(room.width / width, room.height / height, 1.25);
    this.zoom = Math.max(whole, least);
    this.x = 12 + Math.max(0, (room.width - width * this.zoom) / 2);
    this.y = 12 + Math.max(0, (room.height - height * this.zoom) / 2);
    this.show();
  }

  /** Bring a point into the middle. */
  centre(x: number, y: number): void {
    this.zoom = Math.max(this.zoom, 0.9);
    this.x = this.frame.clientWidth / 2 - x * this.zoom;
    this.y = this.frame.clientHeight / 2 - y * this.zoom;
    this.show();
  }

  show(): void {
    this.moved.setAttribute("transform", `translate(${this.x.toFixed(2)} ${this.y.toFixed(2)}) scale(${this.zoom.toFixed(4)})`);
  }
}
