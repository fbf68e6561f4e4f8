// The way in space, with the body's axes, the cloud of particles, and what sensors said, by three.js.

import {
  AxesHelper, BufferAttribute, BufferGeometry, Color, Line, LineBasicMaterial, GridHelper, PerspectiveCamera, Points, PointsMaterial,
  Quaternion, Scene, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { unpack, type Run, type Way } from "./model";
import { before, colour, short } from "./numbers";

const { html } = window.flowgraph.dom;

/** World z is up; in the scene of three.js y is. */
function upright(places: Float32Array): Float32Array {
  const made = new Float32Array(places.length);
  for (let k = 0; k < places.length; k += 3) {
    made[k] = places[k];
    made[k + 1] = places[k + 2];
    made[k + 2] = -places[k + 1];
  }
  return made;
}

function geometry(places: Float32Array): BufferGeometry {
  const finite: number[] = [];
  for (let k = 0; k < places.length; k += 3) {
    if (Number.isFinite(places[k] + places[k + 1] + places[k + 2])) finite.push(places[k], places[k + 1], places[k + 2]);
  }
  return new BufferGeometry().setAttribute("position", new BufferAttribute(upright(new Float32Array(finite)), 3));
}

export class Space {
  readonly element = html("section", { class: "space" });
  private renderer?: WebGLRenderer;
  private scene = new Scene();
  private camera = new PerspectiveCamera(40, 1, 0.01, 1e6);
  private controls?: OrbitControls;
  private body = new AxesHelper(1);
  private cloud?: { times: Float32Array; places: Float32Array; size: number; points: Points };
  private times: Float32Array;
  private path: Float32Array;
  private attitude?: Float32Array;
  private coloured: [{ color: Color }, string][] = [];
  private reading = html("p", { class: "words" });
  private waiting = false;
  private here?: Points;

  constructor(readonly run: Run, readonly way: Way, beside?: Way) {
    this.times = unpack(way.t);
    this.path = unpack(way.estimate);
    if (way.attitude) this.attitude = unpack(way.attitude);
    const frame = html("div", { class: "frame3d", tabindex: "0", role: "img", "aria-label": "The way in space with the axes of the body: x red, y green, z blue. Arrow keys turn it." });
    this.element.append(html("h4", {}, "In space"), frame, this.reading);
    try {
      this.renderer = new WebGLRenderer({ antialias: true, alpha: true });
    } catch {
      frame.append(html("p", { class: "words" }, "This browser has no WebGL, which the way in space needs."));
      return;
    }
    const { renderer, scene, camera } = this;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    frame.append(renderer.domElement);
    const line = (places: Float32Array, name: string) => {
      const material = new LineBasicMaterial();
      this.coloured.push([material, name]);
      scene.add(new Line(geometry(places), material));
    };
    const dots = (places: Float32Array, name: string, size: number) => {
      const material = new PointsMaterial({ size, sizeAttenuation: false, transparent: true, opacity: 0.7 });
      this.coloured.push([material, name]);
      const points = new Points(geometry(places), material);
      points.frustumCulled = false;
      scene.add(points);
      return points;
    };
    line(this.path, "estimate");
    if (way.truth) line(unpack(way.truth), "truth");
    if (beside) line(unpack(beside.estimate), "mark");
    for (const seen of way.seen) dots(unpack(seen.places), "measured", 2.5);
    const box = geometry(this.path);
    box.computeBoundingSphere();
    const radius = Math.max(box.boundingSphere?.radius ?? 1, 1e-3), centre = box.boundingSphere?.center ?? new Vector3();
    this.body.scale.setScalar(radius * 0.3);
    this.body.visible = this.attitude !== undefined;
    scene.add(this.body);
    this.here = dots(this.path.subarray(0, 3), "wrong", 7);
    this.here.visible = this.attitude === undefined;
    const step = 10 ** Math.floor(Math.log10(radius)), cells = Math.max(2, 2 * Math.ceil((1.3 * radius) / step));
    const grid = new GridHelper(cells * step, cells);
    box.computeBoundingBox();
    grid.material.vertexColors = false;
    grid.position.set(centre.x, box.boundingBox?.min.y ?? 0, centre.z);
    this.coloured.push([grid.material, "rule"]);
    scene.add(grid);
    this.reading.dataset.grid = `grid of ${short(step)} ${way.unit}`;
    const cloud = run.watch?.cloud;
    if (cloud) {
      const places = unpack(cloud.places);
      this.cloud = { times: unpack(cloud.times), places, size: cloud.size, points: dots(places.subarray(0, 3 * cloud.size), "clock-3", 2.5) };
    }
    camera.position.copy(centre).add(new Vector3(1.1, 0.9, 1.6).multiplyScalar(1.75 * radius));
    camera.near = radius / 200;
    camera.far = radius * 60;
    this.controls = new OrbitControls(camera, renderer.domElement);
    this.controls.target.copy(centre);
    this.controls.update();
    this.controls.addEventListener("change", () => this.ask());
    frame.addEventListener("keydown", (event) => this.turn(event, centre));
    new ResizeObserver(() => {
      camera.aspect = frame.clientWidth / Math.max(frame.clientHeight, 1);
      camera.updateProjectionMatrix();
      renderer.setSize(frame.clientWidth, frame.clientHeight);
      this.render();
    }).observe(frame);
    this.colours();
    document.addEventListener("recolour", () => this.colours());
  }

  private turn(event: KeyboardEvent, centre: Vector3): void {
    const step: Record<string, [number, number]> = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, 0.3], ArrowDown: [0, -0.3] };
    if (!step[event.key]) return;
    event.preventDefault();
    const [angle, up] = step[event.key], from = this.camera.position.clone().sub(centre);
    from.applyAxisAngle(new Vector3(0, 1, 0), angle);
    from.y += up * from.length() * 0.3;
    this.camera.position.copy(centre).add(from);
    this.controls?.update();
    this.ask();
  }

  private colours(): void {
    for (const [material, name] of this.coloured) material.color.set(colour(name));
    this.ask();
  }

  at(t: number): void {
    const row = Math.max(before(this.times, t + 1e-6), 0);
    const place = this.path.subarray(3 * row, 3 * row + 3);
    this.body.position.fromArray(upright(place));
    this.here?.position.fromArray(upright(place.map((x, k) => x - this.path[k])));
    if (this.attitude) {
      const [w, x, y, z] = this.attitude.subarray(4 * row, 4 * row + 4);
      // body to world, and from there into the scene, which is the world turned by -90 degrees about x
      this.body.quaternion.set(-Math.SQRT1_2, 0, 0, Math.SQRT1_2).multiply(new Quaternion(x, y, z, w));
    }
    let words = `x ${short(place[0])}, y ${short(place[1])}, z ${short(place[2])} ${this.way.unit}; ${this.reading.dataset.grid ?? ""}`;
    if (this.cloud) {
      const { times, places, size, points } = this.cloud, frame = Math.max(before(times, t + 1e-6), 0);
      const attribute = points.geometry.getAttribute("position") as BufferAttribute;
      if (attribute.count === size) {
        attribute.copyArray(upright(places.subarray(3 * size * frame, 3 * size * (frame + 1))));
        attribute.needsUpdate = true;
      }
      words += `; ${size} of ${this.run.watch!.cloud!.of} particles at ${times[frame].toFixed(2)} s`;
    }
    this.reading.textContent = words;
    this.ask();
  }

  /** Draw once for all that has changed. */
  private ask(): void {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.render());
  }

  private render(): void {
    this.waiting = false;
    this.renderer?.render(this.scene, this.camera);
  }

  leave(): void {
    this.controls?.dispose();
    this.renderer?.dispose();
  }
}
