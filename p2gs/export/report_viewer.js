// A small viewer: reads the GLB that p2gs wrote into the page, draws it with WebGL, one slider per joint. No library.
// What it shows it tells as an event "shown" of its canvas, by which report_splats.js draws the Gaussians from the same side.
(function () {
  "use strict";
  const canvas = document.getElementById("view");
  const note = document.getElementById("view-note");
  const bytes = Uint8Array.from(atob(document.querySelector("script.glb").textContent.trim()), (c) => c.charCodeAt(0));
  const head = new DataView(bytes.buffer);
  const jsonLength = head.getUint32(12, true);
  const doc = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + jsonLength)));
  const block = 28 + jsonLength;
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: true });
  if (!gl) {
    note.textContent = "This browser has no WebGL 2, so the 3D view stays empty; the pictures below show the same.";
    return;
  }

  const vertex = `#version 300 es
    in vec3 position; in vec3 normal; in vec4 tint; uniform mat4 camera; uniform mat4 model; out vec3 n; out vec3 c; out vec3 p;
    void main() { vec4 w = model * vec4(position, 1.0); p = w.xyz; n = mat3(model) * normal; c = tint.rgb; gl_Position = camera * w; }`;
  const fragment = `#version 300 es
    precision highp float; in vec3 n; in vec3 c; in vec3 p; uniform vec3 eye; uniform vec4 paint; out vec4 outColor;
    void main() {
      vec3 v = normalize(eye - p); float f = abs(dot(normalize(n), v));
      vec3 base = mix(pow(c, vec3(1.0 / 2.2)), paint.rgb, paint.a);
      outColor = vec4(base * (0.45 + 0.55 * f), 1.0);
    }`;
  function shader(type, source) {
    const s = gl.createShader(type);
    gl.shaderSource(s, source);
    gl.compileShader(s);
    if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(s));
    return s;
  }
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, vertex));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, fragment));
  gl.linkProgram(program);
  gl.useProgram(program);
  const at = (name) => gl.getUniformLocation(program, name);

  function bytesOf(index) {
    const accessor = doc.accessors[index], view = doc.bufferViews[accessor.bufferView];
    return { accessor, data: bytes.subarray(block + view.byteOffset, block + view.byteOffset + view.byteLength) };
  }
  const lo = [Infinity, Infinity, Infinity], hi = [-Infinity, -Infinity, -Infinity];
  const parts = doc.nodes.slice(1).map((node) => {
    if (node.mesh === undefined) return { node, vao: null, count: 0, share: 0 }; // a base of which nothing is seen
    const primitive = doc.meshes[node.mesh].primitives[0], vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    const layout = [["position", "POSITION", 3, gl.FLOAT, false], ["normal", "NORMAL", 3, gl.FLOAT, false], ["tint", "COLOR_0", 4, gl.UNSIGNED_BYTE, true]];
    for (const [name, key, size, type, normalized] of layout) {
      const where = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, bytesOf(primitive.attributes[key]).data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(where);
      gl.vertexAttribPointer(where, size, type, normalized, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const indices = bytesOf(primitive.indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices.data, gl.STATIC_DRAW);
    const box = bytesOf(primitive.attributes.POSITION).accessor;
    for (let i = 0; i < 3; i++) {
      lo[i] = Math.min(lo[i], box.min[i] + node.translation[i]);
      hi[i] = Math.max(hi[i], box.max[i] + node.translation[i]);
    }
    return { node, vao, count: indices.accessor.count, joint: node.extras && node.extras.joint, share: 0 };
  });
  const center = lo.map((v, i) => (v + hi[i]) / 2), radius = Math.hypot(...lo.map((v, i) => hi[i] - v)) / 2;

  function modelOf(part) {
    const t = part.node.translation, j = part.joint, m = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, t[0], t[1], t[2], 1];
    if (!j) return m;
    const value = part.share * j.motion, [x, y, z] = j.axis;
    if (j.type === "prismatic") {
      m[12] += value * x; m[13] += value * y; m[14] += value * z;
      return m;
    }
    const c = Math.cos(value), s = Math.sin(value), k = 1 - c;
    return [c + x * x * k, y * x * k + z * s, z * x * k - y * s, 0, x * y * k - z * s, c + y * y * k, z * y * k + x * s, 0,
      x * z * k + y * s, y * z * k - x * s, c + z * z * k, 0, t[0], t[1], t[2], 1];
  }
  const view = { turn: parseFloat(canvas.dataset.turn || "0"), tilt: 0.4, distance: 3.1 };
  let paintParts = false;
  function draw() {
    const scale = Math.min(window.devicePixelRatio || 1, 2), w = Math.round(canvas.clientWidth * scale), h = Math.round(canvas.clientHeight * scale);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const d = view.distance * radius, ct = Math.cos(view.tilt), st = Math.sin(view.tilt), cy = Math.cos(view.turn), sy = Math.sin(view.turn);
    const back = [ct * sy, st, ct * cy], eye = center.map((v, i) => v + d * back[i]);
    const right = [cy, 0, -sy], up = [-st * sy, ct, -st * cy];
    const f = 1 / Math.tan(0.35) / Math.min(1, w / h), near = d * 0.05, far = d + 4 * radius;
    const dot = (a) => -(a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2]);
    const a = (far + near) / (near - far), b = (2 * far * near) / (near - far), aspect = f * h / w;
    const look = [[...right, dot(right)], [...up, dot(up)], [...back, dot(back)]], camera = [];
    for (let i = 0; i < 4; i++) camera.push(look[0][i] * aspect, look[1][i] * f, look[2][i] * a + (i === 3 ? b : 0), -look[2][i]);
    gl.uniformMatrix4fv(at("camera"), false, camera);
    gl.uniform3fv(at("eye"), eye);
    for (const part of parts) {
      const paint = (part.node.extras && part.node.extras.colour) || [0.66, 0.68, 0.72];
      gl.uniform4f(at("paint"), paint[0], paint[1], paint[2], paintParts ? 0.75 : 0);
      gl.uniformMatrix4fv(at("model"), false, modelOf(part));
      gl.bindVertexArray(part.vao);
      gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_INT, 0);
    }
    const models = Object.fromEntries(parts.map((part) => [part.node.name, modelOf(part)]));
    canvas.dispatchEvent(new CustomEvent("shown", { detail: { eye, right, up, back, cotangent: f, near, far, models } }));
  }
  for (const slider of document.querySelectorAll("input[data-part]")) {
    const part = parts.find((p) => p.node.name === "part_" + slider.dataset.part), out = slider.parentElement.querySelector("output");
    slider.addEventListener("input", () => {
      part.share = parseFloat(slider.value);
      const value = part.share * part.joint.motion;
      out.textContent = part.joint.type === "revolute" ? ((value * 180) / Math.PI).toFixed(1) + "\u00b0" : value.toFixed(3);
      draw();
    });
  }
  // report.html#1=0.5,2=1 opens with joint 1 half way and joint 2 at its end
  for (const [part, share] of location.hash.slice(1).split(",").map((s) => s.split("="))) {
    const slider = document.querySelector(`input[data-part="${CSS.escape(part)}"]`);
    if (slider && share) { slider.value = share; slider.dispatchEvent(new Event("input")); }
  }
  document.getElementById("paint").addEventListener("change", (e) => { paintParts = e.target.checked; draw(); });

  const fingers = new Map();
  function steer(surface) {
    surface.addEventListener("pointerdown", (e) => { fingers.set(e.pointerId, e); surface.setPointerCapture(e.pointerId); });
    for (const name of ["pointerup", "pointercancel"]) surface.addEventListener(name, (e) => fingers.delete(e.pointerId));
    surface.addEventListener("pointermove", turn);
    surface.addEventListener("wheel", (e) => {
      e.preventDefault();
      view.distance = Math.max(1.2, Math.min(12, view.distance * Math.exp(e.deltaY * 0.001)));
      draw();
    }, { passive: false });
  }
  function turn(e) {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    if (fingers.size === 1) {
      view.turn -= (e.clientX - before.clientX) * 0.008;
      view.tilt = Math.max(-1.5, Math.min(1.5, view.tilt + (e.clientY - before.clientY) * 0.008));
    } else {
      const other = [...fingers.values()].find((o) => o.pointerId !== e.pointerId);
      const span = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY) || 1;
      view.distance = Math.max(1.2, Math.min(12, (view.distance * span(before)) / span(e)));
    }
    fingers.set(e.pointerId, e);
    draw();
  }
  for (const surface of document.querySelectorAll("#view, #splats")) steer(surface);
  document.getElementById("splats").addEventListener("ready", draw);
  new ResizeObserver(draw).observe(canvas);
  draw();
})();
