// A surface with one value at each vertex: turn it, come nearer, pick a point. Plain WebGL, nothing fetched.
"use strict";
(() => {
  const VERTEX = `attribute vec3 place; attribute vec3 colour; attribute vec3 normal; uniform mat4 camera; uniform float shade;
    varying vec3 tint; void main() { gl_Position = camera * vec4(place, 1.0);
    float light = 1.0 - shade * 0.45 * (1.0 - abs((camera * vec4(normal, 0.0)).z) / length((camera * vec4(normal, 0.0)).xyz));
    tint = colour * light; }`;
  const FRAGMENT = `precision mediump float; varying vec3 tint; void main() { gl_FragColor = vec4(tint, 1.0); }`;

  const decode = (text, Kind) => {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return new Kind(bytes.buffer);
  };
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const less = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };
  const signed = (x, digits) => (x > 0 ? "+" : x < 0 ? "−" : "") + Math.abs(x).toFixed(digits);

  function colourOf(value, span, stops, unseen) {
    if (!Number.isFinite(value)) return unseen;
    const at = (Math.min(1, Math.max(-1, value / span)) + 1) / 2 * (stops.length - 1);
    const k = Math.min(stops.length - 2, Math.floor(at)), part = at - k;
    return [0, 1, 2].map((c) => stops[k][c] * (1 - part) + stops[k + 1][c] * part);
  }

  function program(gl) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return made;
  }

  function buffer(gl, made, name, data, usage) {
    const handle = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, handle);
    gl.bufferData(gl.ARRAY_BUFFER, data, usage);
    const at = gl.getAttribLocation(made, name);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
    return handle;
  }

  function normalsOf(places, faces) {
    const found = new Float32Array(places.length), p = (i) => [places[3 * i], places[3 * i + 1], places[3 * i + 2]];
    for (let f = 0; f < faces.length; f += 3) {
      const a = p(faces[f]), n = cross(less(p(faces[f + 1]), a), less(p(faces[f + 2]), a));
      for (let k = 0; k < 3; k++) for (let c = 0; c < 3; c++) found[3 * faces[f + k] + c] += n[c];
    }
    for (let i = 0; i < found.length; i += 3) {
      const n = unit([found[i], found[i + 1], found[i + 2]]);
      found.set(n, i);
    }
    return found;
  }

  function start(box) {
    const facts = JSON.parse(box.querySelector("script[type='application/json']").textContent);
    const places = decode(facts.places, Float32Array), values = decode(facts.values, Float32Array);
    const faces = decode(facts.faces, Uint32Array);
    const canvas = box.querySelector("canvas"), label = box.querySelector(".v3-label"), pin = box.querySelector(".v3-pin");
    const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
    if (!gl || !gl.getExtension("OES_element_index_uint")) {
      box.querySelector(".v3-none").hidden = false;
      return;
    }
    const state = { span: facts.span_mm, azimuth: facts.azimuth, elevation: facts.elevation, zoom: 1, pan: [0, 0], shade: 0, picked: null };
    const made = program(gl);
    gl.useProgram(made);
    buffer(gl, made, "place", places, gl.STATIC_DRAW);
    buffer(gl, made, "normal", normalsOf(places, faces), gl.STATIC_DRAW);
    const colours = new Float32Array(places.length);
    const colourBuffer = buffer(gl, made, "colour", colours, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    gl.enable(gl.DEPTH_TEST);

    function paint() {
      for (let i = 0; i < values.length; i++)
        colours.set(colourOf(values[i], state.span, facts.stops, facts.unseen).map((c) => c / 255), 3 * i);
      gl.bindBuffer(gl.ARRAY_BUFFER, colourBuffer);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, colours);
      const ticks = [1, 0.5, 0, -0.5, -1];
      box.querySelector(".v3-ticks").innerHTML = ticks.map((t) => {
        const mm = t * state.span;
        return `<span>${signed(mm, state.span < 1 ? 3 : 2)} mm<small>${signed(100 * mm / facts.diagonal_mm, 2)} %</small></span>`;
      }).join("");
    }

    // Rows of the camera: right, up, towards the eye; a parallel projection, so that lengths compare.
    function frame() {
      const [ca, sa, ce, se] = [Math.cos(state.azimuth), Math.sin(state.azimuth), Math.cos(state.elevation), Math.sin(state.elevation)];
      const eye = [ca * ce, sa * ce, se], right = [-sa, ca, 0];
      return { right, up: cross(eye, right), eye };
    }

    function draw() {
      const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
      if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
        canvas.width = Math.round(w * ratio);
        canvas.height = Math.round(h * ratio);
      }
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(1, 1, 1, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const { right, up, eye } = frame(), size = facts.radius / state.zoom, aspect = w / h;
      const sx = 1 / (size * Math.max(1, aspect)), sy = 1 / (size * Math.max(1, 1 / aspect)), sz = -0.5 / facts.radius, c = facts.centre;
      const row = (axis, s, shift) => [axis.map((x) => x * s), -dot(axis, c) * s + shift];
      const [x, x0] = row(right, sx, state.pan[0]), [y, y0] = row(up, sy, state.pan[1]), [z, z0] = row(eye, sz, 0);
      const camera = [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, x0, y0, z0, 1];
      gl.uniformMatrix4fv(gl.getUniformLocation(made, "camera"), false, camera);
      gl.uniform1f(gl.getUniformLocation(made, "shade"), state.shade);
      gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
      state.camera = { right, up, eye, sx, sy, w, h };
      placePin();
      box.dataset.drawn = String(Number(box.dataset.drawn || 0) + 1);
    }
    let asked = false;
    const redraw = () => { if (!asked) { asked = true; requestAnimationFrame(() => { asked = false; draw(); }); } };

    function placePin() {
      pin.hidden = !state.picked;
      if (!state.picked) return;
      const { right, up, sx, sy, w, h } = state.camera, d = less(state.picked.place, facts.centre);
      pin.style.left = `${(dot(d, right) * sx + state.pan[0] + 1) / 2 * w}px`;
      pin.style.top = `${(1 - dot(d, up) * sy - state.pan[1]) / 2 * h}px`;
    }

    // The first triangle under the pointer, and the value interpolated there.
    function pick(px, py) {
      const { right, up, eye, sx, sy, w, h } = state.camera;
      const u = ((px / w) * 2 - 1 - state.pan[0]) / sx, v = (1 - (py / h) * 2 - state.pan[1]) / sy;
      const base = [0, 1, 2].map((k) => facts.centre[k] + u * right[k] + v * up[k]);
      const p = (i) => [places[3 * i], places[3 * i + 1], places[3 * i + 2]];
      let best = null;
      for (let f = 0; f < faces.length; f += 3) {
        const a = p(faces[f]), ab = less(p(faces[f + 1]), a), ac = less(p(faces[f + 2]), a);
        const n = cross(eye, ac), det = dot(ab, n);
        if (Math.abs(det) < 1e-12) continue;
        const t = less(base, a), s = dot(t, n) / det, q = cross(t, ab), r = dot(eye, q) / det;
        if (s < 0 || r < 0 || s + r > 1) continue;
        const depth = dot(ac, q) / det;
        if (best && depth <= best.depth) continue;
        const value = (1 - s - r) * values[faces[f]] + s * values[faces[f + 1]] + r * values[faces[f + 2]];
        best = { depth, value, place: [0, 1, 2].map((k) => base[k] + depth * eye[k]) };
      }
      return best;
    }

    function tell(found) {
      if (!found) { label.textContent = facts.hint; return; }
      const at = found.place.map((x) => x.toFixed(1).replace("-", "−")).join(", ");
      label.textContent = Number.isFinite(found.value)
        ? `${signed(found.value, 3)} mm = ${signed(100 * found.value / facts.diagonal_mm, 3)} % at (${at}) mm`
        : `not seen by the scan at (${at}) mm`;
      label.dataset.value = Number.isFinite(found.value) ? String(found.value) : "";
    }

    let held = null;
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      held = { x: e.clientX, y: e.clientY, moved: 0, pan: e.button === 2 || e.shiftKey };
    });
    canvas.addEventListener("pointermove", (e) => {
      const edge = canvas.getBoundingClientRect();
      if (!held) { if (!state.picked) tell(pick(e.clientX - edge.left, e.clientY - edge.top)); return; }
      const dx = e.clientX - held.x, dy = e.clientY - held.y;
      held = { ...held, x: e.clientX, y: e.clientY, moved: held.moved + Math.abs(dx) + Math.abs(dy) };
      if (held.pan) {
        state.pan[0] += 2 * dx / canvas.clientWidth;
        state.pan[1] -= 2 * dy / canvas.clientHeight;
      } else {
        state.azimuth -= dx * 0.008;
        state.elevation = Math.min(1.57, Math.max(-1.57, state.elevation + dy * 0.008));
      }
      redraw();
    });
    canvas.addEventListener("pointerup", (e) => {
      if (held && held.moved < 4) {
        const edge = canvas.getBoundingClientRect();
        state.picked = pick(e.clientX - edge.left, e.clientY - edge.top);
        tell(state.picked);
        redraw();
      }
      held = null;
    });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      state.zoom = Math.min(30, Math.max(0.4, state.zoom * Math.exp(-e.deltaY * 0.0015)));
      redraw();
    }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
      if (!step) return;
      e.preventDefault();
      state.azimuth += step[0];
      state.elevation = Math.min(1.57, Math.max(-1.57, state.elevation + step[1]));
      redraw();
    });
    box.querySelectorAll("button[data-view]").forEach((button) => button.addEventListener("click", () => {
      [state.azimuth, state.elevation] = JSON.parse(button.dataset.view);
      [state.zoom, state.pan, state.picked] = [1, [0, 0], null];
      tell(null);
      redraw();
    }));
    box.querySelector(".v3-span").addEventListener("input", (e) => {
      state.span = facts.span_mm * Math.pow(10, Number(e.target.value));
      paint();
      redraw();
    });
    box.querySelector(".v3-shade").addEventListener("change", (e) => { state.shade = e.target.checked ? 1 : 0; redraw(); });
    new ResizeObserver(redraw).observe(canvas);
    tell(null);
    paint();
    draw();
  }

  document.addEventListener("DOMContentLoaded", () => document.querySelectorAll(".v3").forEach(start));
})();
