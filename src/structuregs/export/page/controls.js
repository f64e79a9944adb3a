"use strict";
// The page around the viewer: an orbiting camera for mouse and touch, and the panel of sliders and check boxes.

const HALF_FIELD = Math.PI / 9; // of view
const LOOP_SECONDS = 4; // there and back
const SLOW_MS = 30; // a picture that takes longer is drawn with fewer pixels while things move
const COARSEST = 0.35; // of the pixels along a side
const REST_MS = 200; // without a change, after which the picture is drawn sharp

/** Turns, moves and zooms about a target; z is up. */
class Orbit {
  constructor(canvas, panel, view, changed) {
    this.canvas = canvas;
    this.panel = panel;
    this.start = view;
    this.changed = changed;
    this.pointers = new Map();
    this.reset();
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => this.pointers.delete(e.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.scroll(event), { passive: false });
    canvas.addEventListener("dblclick", () => this.reset());
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  reset() {
    const { target, radius, azimuth, elevation } = this.start;
    Object.assign(this, { target: [...target], distance: (1.1 * radius) / Math.sin(HALF_FIELD), azimuth, elevation });
    this.changed();
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    if (other) {
      this.pan(dx / 2, dy / 2);
      this.zoom(Math.hypot(before.x - other.x, before.y - other.y) / Math.hypot(now.x - other.x, now.y - other.y));
    } else if (event.buttons & 6 || event.shiftKey) {
      this.pan(dx, dy);
    } else {
      this.turn(dx, dy);
    }
  }

  scroll(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : 1);
    this.zoom(Math.exp(Math.min(Math.max(pixels, -150), 150) * 0.0015));
  }

  key(event) {
    const step = { ArrowLeft: [20, 0], ArrowRight: [-20, 0], ArrowUp: [0, 20], ArrowDown: [0, -20] }[event.key];
    if (step) this.turn(...step);
    if (event.key === "+" || event.key === "-") this.zoom(event.key === "+" ? 0.9 : 1 / 0.9);
  }

  turn(dx, dy) {
    this.azimuth -= dx * 0.007;
    this.elevation = Math.min(Math.max(this.elevation + dy * 0.007, -1.55), 1.55);
    this.changed();
  }

  pan(dx, dy) {
    const { R, fx } = this.camera(1);
    for (let j = 0; j < 3; j++) this.target[j] -= ((R[j] * dx + R[3 + j] * dy) * this.distance) / fx;
    this.changed();
  }

  zoom(factor) {
    const { radius } = this.start;
    if (Number.isFinite(factor)) this.distance = Math.min(Math.max(this.distance * factor, 0.05 * radius), 40 * radius);
    this.changed();
  }

  /** The camera of the picture at `ratio` device pixels a pixel; it looks at the middle of what the panel leaves free. */
  camera(ratio) {
    const { clientWidth, clientHeight } = this.canvas;
    const covered = this.panel.getBoundingClientRect();
    const below = covered.width > 0.9 * clientWidth;
    const width = below || !covered.width ? clientWidth : covered.left;
    const height = below ? covered.top : clientHeight;
    const focal = (0.5 * ratio * Math.min(width, height)) / Math.tan(HALF_FIELD);
    const [ca, sa, ce, se] = [this.azimuth, this.elevation].flatMap((a) => [Math.cos(a), Math.sin(a)]);
    return {
      R: [-sa, ca, 0, se * ca, se * sa, -ce, -ce * ca, -ce * sa, -se],
      centre: [ce * ca, ce * sa, se].map((d, i) => this.target[i] + this.distance * d),
      fx: focal,
      fy: focal,
      cx: 0.5 * ratio * width,
      cy: 0.5 * ratio * height,
      width: Math.round(ratio * clientWidth),
      height: Math.round(ratio * clientHeight),
    };
  }
}

/** An element with properties, in it what else is given. */
function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** A joint's value as people read it. */
function amount({ kind }, q) {
  return kind === "revolute" ? `${((q * 180) / Math.PI).toFixed(1)}°` : `${q.toFixed(3)} units`;
}

class Page {
  constructor(scene) {
    const canvas = document.getElementById("picture");
    this.viewer = new Viewer(canvas, scene);
    this.fixed = null; // a camera that setCamera gave
    this.playing = false;
    this.phase = 0;
    this.waiting = false;
    this.coarse = 1; // share of the pixels along a side that is drawn while things move
    this.moving = false;
    this.rest = null; // the timer that ends moving
    this.timing = false;
    const panel = document.getElementById("panel");
    this.fill(panel, scene);
    this.orbit = new Orbit(canvas, panel, scene.view, () => this.refresh());
    canvas.addEventListener("pointerdown", () => this.setCamera(null));
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => location.reload());
    new ResizeObserver(() => this.refresh()).observe(document.body);
  }

  fill(panel, scene) {
    const states = element("div", { className: "states" });
    this.buttons = ["State 0", "State 1", "Play"].map((text) => element("button", { type: "button", textContent: text }));
    this.buttons.slice(0, 2).forEach((button, state) => {
      button.addEventListener("click", () => this.goTo(state));
    });
    this.buttons[2].addEventListener("click", () => this.play(!this.playing));
    states.append(...this.buttons);
    this.sliders = scene.joints.map((_, i) => this.slider(i));
    if (scene.joints.length) panel.append(states, ...this.sliders.map(({ row }) => row));
    const parts = scene.parts.map(({ name, colour }, k) =>
      this.checkBox(name.replace("_", " "), colour, (on) => (this.viewer.shown.parts[k] = on), true));
    const extras = [["boxes", "boxes"], ["joint axes", "axes"]].map(([text, key]) =>
      this.checkBox(text, null, (on) => (this.viewer.shown[key] = on), this.viewer.shown[key]));
    panel.append(element("fieldset", {}, element("legend", { textContent: "Show" }), ...parts, ...extras));
    this.mark();
  }

  /** Takes another scene: each joint at the same share of its way, shown as before, the camera where it is. */
  take(scene) {
    const { scene: before, q, shown } = this.viewer;
    const shares = q.map((value, i) => value / (before.joints[i].q[1] || 1));
    const alike = scene.parts.length === before.parts.length;
    this.viewer.load(scene);
    Object.assign(this.viewer.shown, alike ? shown : { boxes: shown.boxes, axes: shown.axes });
    if (alike) {
      scene.joints.forEach((joint, i) => {
        this.sliders[i].describe(joint);
        this.setJoint(i, shares[i] * joint.q[1]);
      });
    } else {
      const panel = document.getElementById("panel");
      panel.replaceChildren();
      this.fill(panel, scene);
    }
    this.refresh();
  }

  slider(i) {
    const part = this.viewer.scene.parts[i + 1];
    const colour = `rgb(${part.colour.join(",")})`;
    const name = part.name.replace("_", " ");
    const [value, least, most] = [element("output"), element("span"), element("span")];
    const kind = element("span", { className: "kind" });
    const review = element("p", { className: "review" });
    const input = element("input", { type: "range", min: 0, step: "any", id: `joint_${i + 1}` });
    input.style.accentColor = colour;
    input.addEventListener("input", () => {
      this.play(false);
      this.setJoint(i, Number(input.value));
    });
    const head = element("div", { className: "name" }, dot(part.colour), element("b", { textContent: name }), kind, value);
    const row = element("div", { className: "joint" }, head, input, element("div", { className: "range" }, least, most), review);
    const describe = (joint) => {
      kind.textContent = joint.kind === "revolute" ? "turns" : "slides";
      input.setAttribute("aria-label", `${name} ${kind.textContent}`);
      input.max = joint.q[1];
      input.value = this.viewer.q[i];
      value.textContent = amount(joint, this.viewer.q[i]);
      [least.textContent, most.textContent] = joint.q.map((q) => amount(joint, q));
      review.textContent = joint.review;
      review.hidden = !joint.review;
    };
    describe(this.viewer.scene.joints[i]);
    return { row, input, value, describe };
  }

  checkBox(text, colour, set, checked) {
    const input = element("input", { type: "checkbox", checked });
    input.addEventListener("change", () => {
      set(input.checked);
      this.refresh();
    });
    return element("label", {}, input, ...(colour ? [dot(colour)] : []), text);
  }

  setJoint(i, q) {
    const { input, value } = this.sliders[i];
    this.viewer.q[i] = q;
    input.value = q;
    value.textContent = amount(this.viewer.scene.joints[i], q);
    this.mark();
    this.refresh();
  }

  /** Sets all joints: radians or units of length. */
  setJoints(q) {
    q.forEach((value, i) => this.setJoint(i, value));
  }

  goTo(state) {
    this.play(false);
    this.setJoints(this.viewer.scene.joints.map((joint) => joint.q[state]));
  }

  /** Shows on the buttons where the object stands. */
  mark() {
    const { joints } = this.viewer.scene;
    const stands = [0, 1].map((state) => !this.playing && joints.every((joint, i) => this.viewer.q[i] === joint.q[state]));
    [...stands, this.playing].forEach((on, i) => this.buttons[i].setAttribute("aria-pressed", on));
    this.buttons[2].textContent = this.playing ? "Pause" : "Play";
  }

  play(on) {
    if (on === this.playing) return;
    this.playing = on;
    this.mark();
    if (!on) return;
    const { joints } = this.viewer.scene;
    const begun = joints.length ? this.viewer.q[0] / (joints[0].q[1] || 1) : 0;
    this.phase = Math.acos(1 - 2 * Math.min(Math.max(begun, 0), 1)); // goes on from where the first joint stands
    let last = null;
    const frame = (now) => {
      if (!this.playing) return;
      this.phase += last === null ? 0 : (2 * Math.PI * (now - last)) / 1000 / LOOP_SECONDS;
      last = now;
      this.setJoints(this.viewer.scene.joints.map((joint) => ((1 - Math.cos(this.phase)) / 2) * joint.q[1]));
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  /** Looks through a given camera (see Viewer.draw) until the picture is next touched; null: through the orbit's. */
  setCamera(camera) {
    this.fixed = camera;
    this.refresh();
  }

  /** Draws with the next frame, and sharp once nothing changes any more. */
  refresh() {
    if (this.waiting || !this.orbit) return;
    this.waiting = true;
    clearTimeout(this.rest);
    requestAnimationFrame(() => {
      this.waiting = false;
      this.moving = true;
      this.draw();
      this.time();
      this.rest = setTimeout(() => {
        this.moving = false;
        if (this.coarse < 1) this.draw();
      }, REST_MS);
    });
  }

  /** Draws now. */
  draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2) * (this.moving ? this.coarse : 1);
    this.viewer.draw(this.fixed ?? this.orbit.camera(ratio), ratio);
  }

  /** Waits until what was drawn is there, and chooses how coarse to be from how long that took. */
  time() {
    if (this.timing) return;
    this.timing = true;
    const { gl } = this.viewer;
    const begun = performance.now();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      const waited = performance.now() - begun;
      if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED && waited < 1000) return setTimeout(look, 4);
      gl.deleteSync(fence);
      this.timing = false;
      if (waited > SLOW_MS) this.coarse = Math.max(0.8 * this.coarse, COARSEST);
      else if (waited < SLOW_MS / 3) this.coarse = Math.min(1.1 * this.coarse, 1);
    };
    setTimeout(look, 4);
  }

  /** The picture as it stands, as a PNG's data URL. */
  picture() {
    this.draw();
    return this.viewer.canvas.toDataURL();
  }
}

function dot(colour) {
  const made = element("span", { className: "dot" });
  made.style.background = `rgb(${colour.join(",")})`;
  return made;
}

/** Shows the page's first scene. */
function begin(scene) {
  try {
    window.viewer = new Page(scene);
    window.viewer.refresh();
  } catch (error) {
    document.body.append(element("p", { className: "sorry", textContent: error.message }));
  }
}

const given = JSON.parse(document.getElementById("scene").textContent);
if (given) begin(given); // a live page is given none
