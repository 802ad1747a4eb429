// Draws a run's 3D view, `report/view.py`'s buffers, with WebGL. Without it the picture stays.
"use strict";
(() => {
  const figure = document.getElementById("view");
  const canvas = figure.querySelector("canvas");
  const gl = canvas.getContext("webgl", { antialias: true });
  if (!gl) return;
  const data = JSON.parse(document.getElementById("view-data").textContent);

  // --- buffers -----------------------------------------------------------------------------------

  const decoded = (text, Type) =>
    new Type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const uploaded = (target, values) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(target, buffer);
    gl.bufferData(target, values, gl.STATIC_DRAW);
    return buffer;
  };
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
  const points = (text) => {
    const levels = decoded(text, Uint16Array);
    return Array.from({ length: levels.length / 3 }, (_, i) =>
      [0, 1, 2].map((axis) => data.low[axis] + data.step[axis] * levels[3 * i + axis]));
  };

  const meshOf = (positions, normals, triangles, rgba, low, size) => ({
    positions: uploaded(gl.ARRAY_BUFFER, positions),
    normals: uploaded(gl.ARRAY_BUFFER, normals),
    triangles: uploaded(gl.ELEMENT_ARRAY_BUFFER, triangles),
    count: triangles.length, rgba, low, size,
  });

  const bodies = data.bodies.map((body) => ({
    layers: [body.layer],
    poses: decoded(body.poses, Float32Array),
    meshes: body.meshes.map((mesh) => meshOf(
      decoded(mesh.positions, Uint16Array), decoded(mesh.normals, Int8Array),
      decoded(mesh.triangles, Uint16Array), mesh.rgba, mesh.low, mesh.step.map((s) => s * 65535))),
  }));

  // A sphere of radius 1, in 16 bits from -1 to 1.
  const ball = (() => {
    const [around, down] = [64, 32];
    const positions = [], normals = [], triangles = [];
    for (let j = 0; j <= down; j++) {
      for (let i = 0; i <= around; i++) {
        const [u, v] = [2 * Math.PI * i / around, Math.PI * j / down];
        const n = [Math.sin(v) * Math.cos(u), Math.sin(v) * Math.sin(u), Math.cos(v)];
        positions.push(...n.map((x) => Math.round((x + 1) / 2 * 65535)));
        normals.push(...n.map((x) => Math.round(127 * x)));
        if (i < around && j < down) {
          const a = j * (around + 1) + i, b = a + around + 1;
          triangles.push(a, b, a + 1, a + 1, b, b + 1);
        }
      }
    }
    return meshOf(new Uint16Array(positions), new Int8Array(normals), new Uint16Array(triangles));
  })();

  // A line is a strip of rectangles as wide on the screen as asked for; a dot is a short one.
  const stripOf = (pairs) => {
    const values = [];
    for (const [a, b] of pairs) {
      for (const [end, side] of [[0, -1], [0, 1], [1, -1], [1, -1], [0, 1], [1, 1]]) {
        values.push(...a, ...b, end, side);
      }
    }
    return { buffer: uploaded(gl.ARRAY_BUFFER, new Float32Array(values)), count: values.length / 8 };
  };
  const paths = data.lines.map((line) => ({ ...line, points: points(line.points) }));
  const strips = [];
  for (const sphere of new Set(paths.map((path) => path.sphere))) {
    const same = paths.filter((path) => path.sphere === sphere);
    const demonstrated = sphere === null;
    const layers = demonstrated ? ["demonstration"] : ["segments", `sphere-${sphere}`];
    const pairs = same.flatMap((path) => path.points.slice(1).map((p, i) => [path.points[i], p]));
    const ends = same.flatMap(({ points: [first, ...rest] }) =>
      demonstrated ? [first, rest.length ? rest[rest.length - 1] : first] : [first]);
    const colour = demonstrated ? null : rgb(same[0].colour);
    strips.push({ ...stripOf(pairs), layers, colour, width: demonstrated ? 3.2 : 1.5, dot: 0 });
    strips.push({ ...stripOf(ends.map((p) => [p, p])), layers, colour,
      width: demonstrated ? 11 : 6, dot: 1 });
  }

  // --- programs ----------------------------------------------------------------------------------

  const program = (vertex, fragment) => {
    const made = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, `precision highp float;\n${source}`);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) return null;
    const names = (what, get) => Object.fromEntries(
      Array.from({ length: gl.getProgramParameter(made, what) }, (_, i) => get(i)));
    return {
      made,
      at: names(gl.ACTIVE_ATTRIBUTES, (i) => {
        const { name } = gl.getActiveAttrib(made, i);
        return [name, gl.getAttribLocation(made, name)];
      }),
      set: names(gl.ACTIVE_UNIFORMS, (i) => {
        const { name } = gl.getActiveUniform(made, i);
        return [name, gl.getUniformLocation(made, name)];
      }),
    };
  };

  const solid = program(`
    attribute vec3 position, normal;
    uniform vec3 low, size;
    uniform mat4 body, view;
    varying vec3 n, p;
    void main() {
      vec4 world = body * vec4(low + size * position, 1.0);
      p = world.xyz;
      n = mat3(body) * normal;
      gl_Position = view * world;
    }`, `
    uniform vec4 rgba;
    uniform vec3 eye, sun;
    uniform float glass;
    varying vec3 n, p;
    void main() {
      vec3 toward = normalize(eye - p), normal = normalize(n);
      if (dot(normal, toward) < 0.0) normal = -normal;
      float facing = dot(normal, toward);
      if (glass > 0.5) {
        gl_FragColor = vec4(rgba.rgb, rgba.a * mix(0.10, 0.85, pow(1.0 - facing, 2.5)));
      } else {
        float light = 0.50 + 0.32 * max(dot(normal, sun), 0.0) + 0.26 * facing;
        gl_FragColor = vec4(min(rgba.rgb * light, 1.0), rgba.a);
      }
    }`);
  const ribbon = program(`
    attribute vec3 a, b;
    attribute vec2 corner;
    uniform mat4 view;
    uniform vec2 screen;
    uniform float width, dot;
    varying vec2 within;
    void main() {
      vec4 A = view * vec4(a, 1.0), B = view * vec4(b, 1.0);
      vec4 here = corner.x < 0.5 ? A : B;
      vec2 along = (B.xy / B.w - A.xy / A.w) * screen;
      along = dot > 0.5 || length(along) < 1e-6 ? vec2(1.0, 0.0) : normalize(along);
      within = vec2(2.0 * corner.x - 1.0, corner.y);
      // Half a width beyond either end, so that no gap shows where a line bends.
      vec2 away = (vec2(-along.y, along.x) * corner.y + along * within.x) * width;
      here.xy += away / screen * here.w;
      here.z -= 2e-4 * here.w;
      gl_Position = here;
    }`, `
    uniform vec4 rgba;
    uniform float dot;
    varying vec2 within;
    void main() {
      if (dot > 0.5 && length(within) > 1.0) discard;
      gl_FragColor = rgba;
    }`);
  if (!solid || !ribbon) return;

  // --- the eye -----------------------------------------------------------------------------------

  const subtract = (a, b) => a.map((x, i) => x - b[i]);
  const inner = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
    a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => a.map((x) => x / Math.hypot(...a));
  const FIELD = Math.tan(Math.PI * 32 / 360);

  let yaw, pitch, distance, target, reach;
  const look = (at) => {
    reach = at.radius;
    target = [...at.middle];
    [yaw, pitch] = [-0.9, 0.36];
    const narrow = Math.min(1, canvas.clientWidth / Math.max(1, canvas.clientHeight));
    distance = reach / FIELD / narrow;
    changed();
  };
  const axes = () => {
    const back = [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw),
      Math.sin(pitch)];
    const right = unit(cross([0, 0, 1], back));
    return { back, right, up: cross(back, right) };
  };
  const eyeAt = (back) => target.map((x, i) => x + distance * back[i]);
  // Column after column, as WebGL has it.
  const viewed = (eye, { right, up, back }, aspect) => {
    const [near, far] = [distance / 50, distance * 4 + 6];
    const [fx, fy] = [1 / (FIELD * aspect), 1 / FIELD];
    const [dx, dy, dz] = [right, up, back].map((axis) => -inner(axis, eye));
    const z = (far + near) / (near - far), w = 2 * far * near / (near - far);
    return new Float32Array([0, 1, 2].flatMap((i) =>
      [fx * right[i], fy * up[i], z * back[i], -back[i]]).concat([fx * dx, fy * dy, z * dz + w, -dz]));
  };

  // --- drawing -----------------------------------------------------------------------------------

  const boxes = [...figure.querySelectorAll("input[data-layer]")];
  const slider = figure.querySelector("input[type=range]");
  const clock = figure.querySelector("output");
  const shown = (layers) => boxes.every((box) => box.checked || !layers.includes(box.dataset.layer));
  const IDENTITY = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);

  const attribute = (location, buffer, size, type, normalised, stride, offset) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, type, normalised, stride, offset);
  };
  const drawMesh = (mesh, pose, rgba, low, size) => {
    attribute(solid.at.position, mesh.positions, 3, gl.UNSIGNED_SHORT, true, 6, 0);
    attribute(solid.at.normal, mesh.normals, 3, gl.BYTE, true, 3, 0);
    gl.uniformMatrix4fv(solid.set.body, false, pose);
    gl.uniform4fv(solid.set.rgba, rgba);
    gl.uniform3fv(solid.set.low, low);
    gl.uniform3fv(solid.set.size, size);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.triangles);
    gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_SHORT, 0);
  };
  const poseAt = (poses, moment) => {
    const rows = poses.subarray(poses.length > 12 ? 12 * moment : 0);
    return new Float32Array([0, 1, 2, 3].flatMap((i) =>
      [rows[i], rows[4 + i], rows[8 + i], i === 3 ? 1 : 0]));
  };

  const draw = () => {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    const style = getComputedStyle(canvas);
    const numbers = (text) => text.match(/[\d.]+/g).slice(0, 3).map((x) => x / 255);
    gl.clearColor(...numbers(style.backgroundColor), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const moment = Number(slider.value);
    clock.textContent = `${data.times[moment].toFixed(1)} s`;
    const frame = axes();
    const eye = eyeAt(frame.back);
    const view = viewed(eye, frame, canvas.width / Math.max(1, canvas.height));
    const ink = numbers(style.color);

    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.useProgram(solid.made);
    gl.uniformMatrix4fv(solid.set.view, false, view);
    gl.uniform3fv(solid.set.eye, eye);
    gl.uniform3fv(solid.set.sun, unit([0.3, -0.5, 1.0]));
    gl.uniform1f(solid.set.glass, 0);
    for (const body of bodies) {
      if (!shown(body.layers)) continue;
      const pose = poseAt(body.poses, moment);
      for (const mesh of body.meshes) drawMesh(mesh, pose, mesh.rgba, mesh.low, mesh.size);
    }

    gl.useProgram(ribbon.made);
    gl.uniformMatrix4fv(ribbon.set.view, false, view);
    gl.uniform2f(ribbon.set.screen, canvas.width, canvas.height);
    for (const strip of strips) {
      if (!shown(strip.layers)) continue;
      attribute(ribbon.at.a, strip.buffer, 3, gl.FLOAT, false, 32, 0);
      attribute(ribbon.at.b, strip.buffer, 3, gl.FLOAT, false, 32, 12);
      attribute(ribbon.at.corner, strip.buffer, 2, gl.FLOAT, false, 32, 24);
      gl.uniform1f(ribbon.set.width, strip.width * ratio);
      gl.uniform1f(ribbon.set.dot, strip.dot);
      gl.uniform4fv(ribbon.set.rgba, [...(strip.colour || ink), 1]);
      gl.drawArrays(gl.TRIANGLES, 0, strip.count);
    }
    gl.disableVertexAttribArray(ribbon.at.corner);

    // Glass last, from the farthest on, each with its back before its front.
    gl.useProgram(solid.made);
    gl.uniform1f(solid.set.glass, 1);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    const far = (at) => inner(subtract(at.centre, eye), frame.back) - at.radius;
    for (const at of [...data.balls].sort((a, b) => far(a) - far(b))) {
      if (!shown(["spheres", `sphere-${at.sphere}`])) continue;
      const low = at.centre.map((x) => x - at.radius);
      for (const side of [gl.FRONT, gl.BACK]) {
        gl.cullFace(side);
        drawMesh(ball, IDENTITY, [...rgb(at.colour), 1], low, Array(3).fill(2 * at.radius));
      }
    }
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
    if (gl.getError() === gl.NO_ERROR) canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
  };

  let due = false;
  const changed = () => {
    if (due) return;
    due = true;
    requestAnimationFrame(() => { due = false; draw(); });
  };

  // --- hands -------------------------------------------------------------------------------------

  const turn = (dx, dy) => {
    yaw -= dx * 0.008;
    pitch = Math.min(1.5, Math.max(-1.2, pitch + dy * 0.008));
    changed();
  };
  const zoom = (factor) => {
    distance = Math.min(20 * reach, Math.max(0.05 * reach, distance * factor));
    changed();
  };
  const shift = (dx, dy) => {
    const { right, up } = axes();
    const scale = 2 * FIELD * distance / Math.max(1, canvas.clientHeight);
    target = target.map((x, i) => x + scale * (dy * up[i] - dx * right[i]));
    changed();
  };

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = subtract(now, before);
    fingers.set(event.pointerId, now);
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const apart = (p) => Math.max(1, Math.hypot(...subtract(p, other)));
      zoom(apart(before) / apart(now));
      shift(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) {
      shift(dx, dy);
    } else {
      turn(dx, dy);
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  // Until the view is clicked the wheel scrolls the page, so that nobody gets stuck over it.
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    zoom(Math.exp(0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const act = {
      ArrowLeft: () => turn(-15, 0), ArrowRight: () => turn(15, 0),
      ArrowUp: () => turn(0, 15), ArrowDown: () => turn(0, -15),
      "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1),
    }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
  for (const box of boxes) box.addEventListener("change", changed);
  for (const button of figure.querySelectorAll("button[data-look]")) {
    button.addEventListener("click", () => look(data[button.dataset.look]));
  }

  const play = figure.querySelector("button[data-play]");
  let started = null;
  const pause = () => {
    started = null;
    play.textContent = "▶ Play";
  };
  const advance = (now) => {
    if (started === null) return;
    const seconds = (now - started) / 1000;
    const next = data.times.findIndex((time) => time >= seconds);
    slider.value = next < 0 ? data.times.length - 1 : next;
    changed();
    if (next < 0) pause();
    else requestAnimationFrame(advance);
  };
  play.addEventListener("click", () => {
    if (started !== null) return pause();
    const from = Number(slider.value) === data.times.length - 1 ? 0 : Number(slider.value);
    started = performance.now() - 1000 * data.times[from];
    play.textContent = "❚❚ Pause";
    requestAnimationFrame(advance);
  });
  slider.addEventListener("input", () => { pause(); changed(); });
  canvas.addEventListener("webglcontextlost", () => figure.classList.remove("live"));
  new ResizeObserver(changed).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);

  figure.classList.add("live");
  look(data.whole);
})();
