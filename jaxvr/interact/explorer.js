// The browser's side of jaxvr.explore: a picture to be turned, an editor of its transfer function.
//
// The state lives in Python. What a hand does is gathered here until the next request, and there is
// one request at a time. Where points are dragged the drawing does not wait for the answer.

const REST = 200; // milliseconds without input until the exact picture is asked for
const PATIENCE = 300; // until a missing answer is mentioned
const DEGREES = 200; // of rotation for a drag as long as the picture is high
const PLOT = { width: 560, height: 150, left: 14, right: 14, top: 20, floor: 128, radius: 6 };
const SVG = "http://www.w3.org/2000/svg";

function node(name, attributes = {}, ...children) {
  const it = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value);
  it.append(...children);
  return it;
}

function draw(parent, name, attributes) {
  const it = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value);
  parent.append(it);
  return it;
}

const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const short = (x) => String(+x.toPrecision(4));

// A scalar with the digits that tell a thousandth of the range: far from 0 four are too few.
function scalar(x, low, high) {
  const times = Math.max(Math.abs(low), Math.abs(high)) / (high - low);
  const digits = times > 0 && times < 1e14 ? 3 + Math.ceil(Math.log10(times)) : 4;
  return String(+x.toPrecision(Math.min(Math.max(digits, 4), 17)));
}

function stop(event) {
  event.preventDefault();
  event.stopPropagation();
}

// Requests: `add` gathers what happened, `ask` sends it when the last answer is there.
function requests(model, say) {
  const view = Math.random().toString(36).slice(2);
  let pending = {};
  let waiting = 0; // since when, 0 if nothing is on its way
  let moved = false;
  let exact = false;
  let timer, patience;

  function ask() {
    if (waiting || !(moved || exact)) return;
    waiting = performance.now();
    model.send({ kind: "frame", view, exact: exact && !moved, ...pending });
    if (exact && !moved) exact = false;
    pending = {};
    moved = false;
    patience = setTimeout(() => say("computing …"), PATIENCE);
  }

  function rest() {
    clearTimeout(timer);
    timer = setTimeout(() => {
      exact = true;
      ask();
    }, REST);
  }

  return {
    // `change` adds to what is pending.
    add(change) {
      change(pending);
      moved = true;
      exact = false;
      ask();
      rest();
    },
    // An answer: whether it is to a request of this view, and nothing has happened since.
    answered(message) {
      if (message.view === view) {
        clearTimeout(patience);
        waiting = 0;
        if (message.exact && !moved) clearTimeout(timer), (exact = false);
        ask();
      }
      return !moved;
    },
    close() {
      clearTimeout(timer);
      clearTimeout(patience);
    },
  };
}

function picture(setup, requests) {
  const { width, height } = setup;
  const canvas = node("canvas", {
    width,
    height,
    tabindex: 0,
    role: "application",
    "aria-label":
      "Volume rendering. Arrow keys rotate, plus and minus zoom, 0 starts again.",
  });
  canvas.style.width = `${width}px`;
  const context = canvas.getContext("2d");

  const turn = (azimuth, elevation) =>
    requests.add((p) => {
      const [a, e] = p.turn ?? [0, 0];
      p.turn = [a + azimuth, e + elevation];
    });
  const shift = (right, up) =>
    requests.add((p) => {
      const [r, u] = p.shift ?? [0, 0];
      p.shift = [r + right, u + up];
    });
  const zoom = (factor) => requests.add((p) => (p.zoom = (p.zoom ?? 1) * factor));
  const again = () =>
    requests.add((p) => {
      for (const move of ["up", "angles", "turn", "shift", "zoom"]) delete p[move];
      p.reset = [...(p.reset ?? []), "view"];
    });

  let last = null;
  canvas.addEventListener("pointerdown", (event) => {
    last = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    stop(event);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!last) return;
    const high = canvas.getBoundingClientRect().height;
    const x = (event.clientX - last[0]) / high;
    const y = (event.clientY - last[1]) / high;
    last = [event.clientX, event.clientY];
    if (event.shiftKey || event.buttons & 6) shift(x, -y);
    else turn(-x * DEGREES, y * DEGREES);
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, () => (last = null));
  canvas.addEventListener("contextmenu", stop);
  canvas.addEventListener("dblclick", (event) => (stop(event), again()));
  canvas.addEventListener(
    "wheel",
    (event) => {
      stop(event);
      const pixels = event.deltaY * [1, 16, 400][event.deltaMode];
      zoom(Math.exp(-0.0015 * clamp(pixels, -400, 400)));
    },
    { passive: false },
  );
  const keys = {
    ArrowLeft: () => turn(5, 0),
    ArrowRight: () => turn(-5, 0),
    ArrowUp: () => turn(0, -5),
    ArrowDown: () => turn(0, 5),
    "+": () => zoom(1.15),
    "=": () => zoom(1.15),
    "-": () => zoom(1 / 1.15),
    0: again,
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
    stop(event);
    keys[event.key]();
  });

  let newest = 0;
  async function show(bytes) {
    const mine = ++newest;
    const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    if (mine !== newest) return;
    context.clearRect(0, 0, width, height);
    context.imageSmoothingQuality = "high";
    context.drawImage(bitmap, 0, 0, width, height);
    bitmap.close();
  }
  return { canvas, show };
}

// Buttons for the axis that is up and for views by name.
function buttons(setup, requests) {
  const make = (text, title, press) => {
    const it = node("button", { type: "button", title, "aria-pressed": "false" }, text);
    it.addEventListener("click", press);
    return it;
  };
  const ups = setup.ups.map((name) => {
    const press = () => requests.add((p) => (p.up = name));
    return make(name.replace("-", "−"), `Turn ${name} up`, press);
  });
  const views = Object.entries(setup.views).map(([name, angles]) => {
    const title = `Look from azimuth ${angles[0]}°, elevation ${angles[1]}°`;
    const press = () =>
      requests.add((p) => {
        delete p.turn; // of before
        p.angles = angles;
      });
    return make(name, title, press);
  });
  const row = node(
    "div",
    { class: "row buttons" },
    node("span", { role: "group", "aria-label": "Axis that is up" }, "up ", ...ups),
    node("span", { role: "group", "aria-label": "Views" }, "view ", ...views),
  );
  const press = (it, on) => it.setAttribute("aria-pressed", String(on));
  function adopt(state) {
    setup.ups.forEach((name, k) => press(ups[k], state.up === name));
    Object.values(setup.views).forEach(([azimuth, elevation], k) => {
      const turned = Math.abs(((state.azimuth - azimuth + 540) % 360) - 180);
      press(views[k], turned < 1e-6 && Math.abs(state.elevation - elevation) < 1e-6);
    });
  }
  return { row, adopt };
}

// Where the picture is seen from, in words.
function stands(state) {
  const [a, e] = [state.azimuth, state.elevation].map((x) => x.toFixed(1));
  const up = `${state.up} up${state.chosen ? ", which shows most" : ""}`;
  const from = state.from ? `  from ${state.from}` : "";
  return `${up}  azimuth ${a}°  elevation ${e}°${from}  zoom ${state.zoom.toFixed(2)}`;
}

function editor(setup, requests) {
  const svg = document.createElementNS(SVG, "svg");
  const { width, height, left, right, top, floor, radius } = PLOT;
  for (const [key, value] of Object.entries({
    viewBox: `0 0 ${width} ${height}`,
    tabindex: 0,
    role: "application",
    "aria-label":
      "Transfer function. Arrow keys move the selected point, Tab selects the next, Delete removes it.",
  }))
    svg.setAttribute(key, value);
  const color = node("input", { type: "color", title: "Colour of the selected point" });
  const about = node("span", { class: "about" });
  const reset = node("button", { type: "button", title: "As it was at the start" }, "reset");
  const row = node("div", { class: "row" }, color, about, reset);

  let points = []; // {x, e, color}
  let selected = 0;
  let dragged = false;
  let highest = 1; // extinction at the top of the plot
  let [low, high] = setup.range;

  const px = (x) =>
    high > low ? left + ((x - low) / (high - low)) * (width - left - right) : width / 2;
  const py = (e) => floor - (e / highest) * (floor - top);
  const sx = (p) => low + ((p - left) / (width - left - right)) * (high - low);
  const se = (p) => ((floor - p) / (floor - top)) * highest;
  const id = `jaxvr-${Math.random().toString(36).slice(2)}`;

  function scale() {
    low = Math.min(setup.range[0], ...points.map((p) => p.x));
    high = Math.max(setup.range[1], ...points.map((p) => p.x));
    const most = Math.max(...points.map((p) => p.e));
    if (most > 0.95 * highest || most < 0.4 * highest) highest = most > 0 ? 1.2 * most : 1;
  }

  function redraw() {
    svg.replaceChildren();
    const defs = draw(svg, "defs", {});
    const fill = draw(defs, "linearGradient", {
      id, gradientUnits: "userSpaceOnUse", x1: left, x2: width - right, y1: 0, y2: 0,
    }); // prettier-ignore
    const wide = width - left - right;
    for (const p of points)
      draw(fill, "stop", { offset: (px(p.x) - left) / wide, "stop-color": p.color });
    // The histogram by square roots, so that rare values are seen too.
    const counts = setup.counts.map(Math.sqrt);
    const most = Math.max(...counts, 1);
    const [first, last] = [px(setup.range[0]), px(setup.range[1])];
    const step = (last - first) / counts.length;
    const bars = counts.map(
      (c, k) => `V${floor - (c / most) * (floor - top)}H${first + (k + 1) * step}`,
    );
    const at = points.map((p) => [px(p.x), py(p.e)]);
    const curve = [[left, at[0][1]], ...at, [width - right, at.at(-1)[1]]];
    const area = [[left, floor], ...curve, [width - right, floor]];
    draw(svg, "polygon", { points: area.join(" "), fill: `url(#${id})`, "fill-opacity": 0.8 });
    if (last > first)
      draw(svg, "path", { d: `M${first},${floor}${bars.join("")}V${floor}Z`, class: "bars" });
    draw(svg, "polyline", { points: curve.join(" "), class: "curve" });
    draw(svg, "line", { x1: left, x2: width - right, y1: floor, y2: floor, class: "axis" });
    const say = (x, y, anchor, text) =>
      (draw(svg, "text", { x, y, "text-anchor": anchor }).textContent = text);
    say(left, 13, "start", `extinction, up to ${short(highest)}`);
    say(left, height - 6, "start", scalar(low, low, high));
    say(width / 2, height - 6, "middle", setup.field);
    say(width - right, height - 6, "end", scalar(high, low, high));
    points.forEach((p, k) => {
      const [cx, cy] = at[k];
      const name = k === selected ? "point selected" : "point";
      const r = points.length > 40 ? 3 : radius;
      draw(svg, "circle", { cx, cy, r, fill: p.color, class: name, "data-point": k });
    });
    const p = points[selected];
    color.value = p.color;
    about.textContent =
      `point ${selected + 1} of ${points.length}: ` +
      `${setup.field} ${scalar(p.x, low, high)}, extinction ${short(p.e)}`;
  }

  // Later edits of one point take the place of earlier ones.
  function edit(change) {
    requests.add((p) => {
      const list = (p.edits ??= []);
      const before = list.at(-1);
      if (before && before.edit === change.edit && before.index === change.index) list.pop();
      list.push(change);
    });
  }

  function move(k, x, e) {
    const p = points[k];
    p.x = clamp(x, points[k - 1]?.x ?? low, points[k + 1]?.x ?? high);
    p.e = clamp(e, 0, highest);
    redraw();
    edit({ edit: "move", index: k, position: p.x, extinction: p.e });
  }

  function remove(k) {
    if (points.length === 1) return;
    points.splice(k, 1);
    selected = clamp(selected > k ? selected - 1 : selected, 0, points.length - 1);
    redraw();
    requests.add((p) => (p.edits ??= []).push({ edit: "remove", index: k }));
  }

  function add(x, e) {
    const above = points.findIndex((p) => p.x > x);
    const k = above < 0 ? points.length : above;
    const near = points[clamp(k, 0, points.length - 1)]; // its colour, until the answer is there
    points.splice(k, 0, { x, e, color: near.color });
    selected = k;
    redraw();
    const change = { edit: "add", position: x, extinction: e };
    requests.add((p) => (p.edits ??= []).push(change));
  }

  function place(event) {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(
      svg.getScreenCTM().inverse(),
    );
    return [at.x, at.y];
  }

  function nearest(event) {
    const [x, y] = place(event);
    const distance = points.map((p) => Math.hypot(px(p.x) - x, py(p.e) - y));
    const k = distance.indexOf(Math.min(...distance));
    return distance[k] < 2 * radius ? k : null;
  }

  svg.addEventListener("pointerdown", (event) => {
    stop(event);
    svg.focus({ preventScroll: true });
    const k = nearest(event);
    if (k === null) return;
    if (event.button === 2) return remove(k);
    selected = k;
    dragged = true;
    svg.setPointerCapture(event.pointerId);
    redraw();
  });
  svg.addEventListener("pointermove", (event) => {
    if (!dragged) return void (svg.style.cursor = nearest(event) === null ? "copy" : "grab");
    const [x, y] = place(event);
    move(selected, high > low ? sx(x) : points[selected].x, se(y));
  });
  for (const end of ["pointerup", "pointercancel"])
    svg.addEventListener(end, () => {
      if (!dragged) return;
      dragged = false;
      scale();
      redraw();
    });
  svg.addEventListener("contextmenu", stop);
  svg.addEventListener("dblclick", (event) => {
    stop(event);
    const [x, y] = place(event);
    if (nearest(event) !== null || !(high > low)) return;
    add(clamp(sx(x), low, high), clamp(se(y), 0, highest));
  });
  svg.addEventListener("keydown", (event) => {
    const p = points[selected];
    if (!p) return;
    const [dx, de] = [0.01 * (high - low), 0.02 * highest];
    const next = selected + (event.shiftKey ? -1 : 1);
    const keys = {
      ArrowLeft: () => move(selected, p.x - dx, p.e),
      ArrowRight: () => move(selected, p.x + dx, p.e),
      ArrowUp: () => move(selected, p.x, p.e + de),
      ArrowDown: () => move(selected, p.x, p.e - de),
      Delete: () => remove(selected),
      Backspace: () => remove(selected),
    };
    if (event.key === "Tab" && next in points) keys.Tab = () => ((selected = next), redraw());
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
    stop(event);
    keys[event.key]();
  });
  svg.addEventListener("keyup", () => (dragged || !points.length ? 0 : (scale(), redraw())));
  color.addEventListener("input", () => {
    if (!points.length) return;
    points[selected].color = color.value;
    redraw();
    edit({ edit: "color", index: selected, color: color.value });
  });
  reset.addEventListener("click", () =>
    requests.add((p) => {
      delete p.edits;
      p.reset = [...(p.reset ?? []), "transfer"];
    }),
  );

  // What Python has, unless a point is in the hand.
  function adopt(state) {
    if (dragged) return;
    points = state.positions.map((x, k) => ({
      x, e: state.extinctions[k], color: state.colors[k],
    })); // prettier-ignore
    selected = clamp(selected, 0, points.length - 1);
    scale();
    redraw();
  }
  return { svg, row, adopt };
}

function render({ model, el }) {
  const setup = model.get("setup");
  const view = node("span");
  const quality = node("span", { class: "quality", role: "status" });
  const say = (text, name = "") => {
    quality.textContent = text;
    quality.className = `quality ${name}`;
  };
  const queue = requests(model, say);
  const { canvas, show } = picture(setup, queue);
  const turns = buttons(setup, queue);
  const { svg, row, adopt } = editor(setup, queue);
  const told = node("div", { class: "told" });
  const help =
    "Picture: drag to rotate, scroll to zoom, shift-drag to move, double-click to start again. " +
    "Curve: drag points, double-click to add one, right-click or Delete to remove one.";
  const root = node(
    "div",
    { class: "jaxvr-explorer", "data-lm-suppress-shortcuts": "true" },
    canvas,
    node("div", { class: "row" }, view, quality),
    turns.row,
    svg,
    row,
    told,
    node("div", { class: "help" }, help),
  );
  root.style.width = `${Math.max(setup.width, 320)}px`;
  el.append(root);

  function receive(message, buffers) {
    const tell = (state) => (told.textContent = state.told);
    if (message.kind === "changed") {
      adopt(message.state);
      tell(message.state);
      queue.add(() => {});
      return;
    }
    if (message.kind !== "frame") return;
    const current = queue.answered(message);
    const state = message.state;
    if (state) {
      view.textContent = stands(state);
      turns.adopt(state);
      tell(state);
      if (current) adopt(state);
    }
    if (message.error) return say(message.error, "error");
    const kind = message.exact ? "exact" : `coarse ${message.width} × ${message.height}`;
    const time = `${message.milliseconds.toFixed(0)} ms${message.compiled ? ", compiled" : ""}`;
    say(`${kind} · ${time}`, message.exact ? "exact" : "");
    show(buffers[0]);
  }
  model.on("msg:custom", receive);
  queue.add(() => {});
  return () => {
    model.off("msg:custom", receive);
    queue.close();
  };
}

export default { render };
