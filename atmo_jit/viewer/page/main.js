// Controls, pointer and keyboard; when to draw, and what the figures say.

import {LIMITS, View} from "./camera.js";
import {Renderer} from "./renderer.js";
import {Tables, ask, framed} from "./tables.js";

const byId = (id) => document.getElementById(id);
const canvas = byId("picture");
const STILL_MS = 200, SLOW_MS = 50, COARSEST = 4;  // a moving picture slower than that is drawn coarser
const AEROSOL = "mie.scattering_per_m", ASYMMETRY = "mie.phase.g", OZONE = "ozone.absorption_per_m";
const ALBEDO = "ground_albedo";

const sliders = {};
let state, view, renderer, tables, exposure = 1, coarse = 1, pending = false, timer = 0, began = 0, first = true;

const degrees = (x) => `${x.toFixed(1)}\u00b0`;
const metres = (x) => (x < 1000 ? `${x.toFixed(0)} m` : `${(x / 1000).toPrecision(3).replace(/e.*/, "")} km`);
const kilometres = (x) => (x < 1e6 ? metres(x) : `${Math.round(x / 1000)} km`);
const percent = (x) => `${(100 * x).toPrecision(2)}\u00a0%`;
const milliseconds = (s) => `${Math.round(1000 * s)}\u00a0ms`;

/** A labelled slider. `to` and `from` turn its value into the slider's place and back. */
function slider(parent, {id, label, low, high, step, value, text, to = (x) => x, from = (x) => x}, moved) {
    const row = document.createElement("div");
    row.className = "row";
    row.innerHTML = "<label></label><output aria-live=off></output><input type=range>";
    const [name, output, input] = row.children;
    name.textContent = label;
    input.id = name.htmlFor = id;
    output.htmlFor = id;
    Object.assign(input, {min: to(low), max: to(high), step});
    const show = (x) => {
        if (document.activeElement !== input || Math.abs(from(+input.value) - x) > 1e-9) input.value = to(x);
        output.value = text(x);
        input.setAttribute("aria-valuetext", text(x));
    };
    input.addEventListener("input", () => {
        const x = from(+input.value);
        output.value = text(x);
        input.setAttribute("aria-valuetext", text(x));
        moved(x);
    });
    const before = parent.querySelector("button, .check");
    parent.insertBefore(row, before);
    show(value);
    sliders[id] = {show, input};
}

function buildControls() {
    const log = {to: Math.log10, from: (x) => 10 ** x};
    const add = (parent, name, label, step, text, more = {}) => {
        const [low, high] = LIMITS[name];
        slider(byId(parent), {id: name, label, low, high, step, value: view[name], text, ...more}, (x) => {
            view.set(name, x);
            look();
        });
    };
    add("sun", "sun_zenith_deg", "Zenith angle", 0.1, degrees);
    add("sun", "sun_azimuth_deg", "Azimuth", 0.5, degrees);
    add("camera", "altitude_m", "Altitude", 0.005, kilometres, log);
    add("camera", "yaw_deg", "Looks toward", 0.5, degrees);
    add("camera", "pitch_deg", "Pitch", 0.25, degrees);
    add("camera", "fov_deg", "Field of view", 0.5, degrees);
    add("exposure", "stops", "Exposure", 0.1, (x) => `${x > 0 ? "+" : ""}${x.toFixed(1)} stops`);

    const has = state.controls, parent = byId("air");
    const air = (name, label, spec) => {
        if (!(name in has)) return;
        slider(parent, {id: name, label, value: has[name], ...spec}, (x) => {
            tables.change({...tables.parameters, [name]: x});
        });
    };
    const perMetre = (x) => `${x.toExponential(2)} /m`;
    const aerosol = has[AEROSOL];
    air(AEROSOL, "Aerosol scattering", {low: aerosol / 100, high: aerosol * 100, step: 0.01, text: perMetre, ...log});
    air(ASYMMETRY, "Asymmetry g", {low: -0.5, high: 0.95, step: 0.005, text: (x) => x.toFixed(3)});
    const ozone = has[OZONE];
    air(OZONE, "Ozone", {
        low: 0, high: 5 * ozone, step: 0.02, text: (x) => `${(x / ozone).toFixed(2)} x the file's`,
        to: (x) => x / ozone, from: (x) => x * ozone,
    });
    air(ALBEDO, "Ground albedo", {low: 0, high: 1, step: 0.01, text: (x) => x.toFixed(2)});
}

/** The view changed: show it, with the tables that it needs. */
function look() {
    for (const name of Object.keys(LIMITS)) sliders[name].show(view[name]);
    tables.want(view);
    request();
}

function request() {
    if (pending) return;
    pending = true;
    requestAnimationFrame(() => {
        pending = false;
        if (tables.has(tables.needs(view))) paint();
    });
}

function size(scale) {
    return [Math.max(1, Math.round(canvas.width / scale)), Math.max(1, Math.round(canvas.height / scale))];
}

/** Draw once: as coarsely as takes SLOW_MS at most while things move, and in full when they stand still. */
function paint() {
    const start = performance.now(), scale = coarse, compiles = first;
    draw(scale);
    renderer.finish();
    if (compiles) return;
    const ms = performance.now() - start, whole = ms * scale ** 2;
    byId("frame").textContent = `${ms.toFixed(0)}\u00a0ms${scale > 1 ? ` at 1/${scale} size` : ""}`;
    coarse = [1, 2, 4].find((c) => whole / c ** 2 <= SLOW_MS) || COARSEST;
    clearTimeout(timer);
    if (scale > 1) timer = setTimeout(() => draw(1), STILL_MS);
}

function draw(scale) {
    if (!byId("hold").checked) exposure = renderer.meter(view, canvas.width / canvas.height);
    const picture = renderer.draw(view, exposure * 2 ** view.stops, ...size(scale));
    if (first) {
        first = false;
        byId("progress").hidden = true;
        document.documentElement.dataset.firstPictureMs = performance.now().toFixed(0);
    }
    return picture;
}

const events = {
    upload: (about, numbers) => renderer.upload(about, numbers),
    changed(about) {
        byId("message").hidden = true;
        byId("seconds").textContent = `${milliseconds(about.solve_s)}, ${milliseconds(about.bake_s)}`;
        byId("view-error").textContent = "...";
        byId("whole-error").textContent = "";
        // While a slider moves on, the sky of its last place but one is shown rather than none.
        const moved = about.began !== undefined && about.began !== began;
        if (!moved && !tables.has(tables.needs(view))) return;
        paint();
        if (moved) {
            began = about.began;
            const wait = performance.now() - began;
            byId("latency").textContent = `${wait.toFixed(0)} ms`;
            document.documentElement.dataset.latencyMs = wait.toFixed(1);
        }
    },
    known(share) {
        byId("known").textContent = share < 1 ? `${Math.floor(100 * share)} % of the texels solved` : "All texels solved";
        document.documentElement.dataset.known = share;
    },
    error(found) {
        if (found.view) {
            const {median, p99} = found.view;
            byId("view-error").textContent = `median ${percent(median)}, p99 ${percent(p99)}`;
        }
        if (!found.whole) return;
        const parts = Object.entries(found.whole).map(([k, e]) => `${k} ${percent(e.median)}, p99 ${percent(e.p99)}`);
        byId("whole-error").textContent = `Radiance against the solution, median and p99: ${parts.join("; ")}.`;
    },
    fail: showError,
};

function showError(error) {
    byId("message").textContent = error.message;
    byId("message").hidden = false;
    byId("progress").hidden = true;
}

function save(blob, name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

async function savePng() {
    draw(1);
    save(await new Promise((done) => canvas.toBlob(done, "image/png")), "sky.png");
}

async function saveExr() {
    const picture = draw(1), {width, height} = picture, rgba = renderer.read(picture);
    const rgb = new Float32Array(3 * width * height);
    for (let y = 0, to = 0; y < height; y++) {
        for (let x = 0, from = 4 * (height - 1 - y) * width; x < width; x++, from += 4) {
            rgb[to++] = rgba[from];
            rgb[to++] = rgba[from + 1];
            rgb[to++] = rgba[from + 2];
        }
    }
    const parameters = JSON.stringify(tables.parameters);
    const about = {...view, atmosphere: state.name, parameters};
    const answer = await ask("exr", framed({width, height, about}, rgb), "application/octet-stream");
    save(await answer.blob(), "sky.exr");
}

async function saveAtmosphere() {
    const answer = await ask("atmosphere", JSON.stringify({parameters: tables.parameters}));
    save(await answer.blob(), "atmosphere.json");
}

function listen() {
    for (const [id, action] of Object.entries({png: savePng, exr: saveExr, json: saveAtmosphere})) {
        byId(id).addEventListener("click", () => action().catch(showError));
    }
    byId("hold").addEventListener("change", request);
    byId("reset").addEventListener("click", () => {
        for (const [name, value] of Object.entries(state.controls)) sliders[name].show(value);
        tables.change({});
    });
    canvas.addEventListener("webglcontextlost", () => showError(new Error("The picture is lost: reload the page.")));
    byId("panel").addEventListener("submit", (event) => event.preventDefault());

    const pointers = new Map();
    const perPixel = () => view.fov_deg / Math.max(canvas.clientWidth, canvas.clientHeight);
    const spread = () => {
        const [a, b] = [...pointers.values()];
        return Math.hypot(a.x - b.x, a.y - b.y);
    };
    canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
    });
    canvas.addEventListener("pointermove", (event) => {
        const last = pointers.get(event.pointerId);
        if (!last) return;
        const before = pointers.size === 2 ? spread() : 0;
        const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
        pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
        if (pointers.size === 2) {
            view.set("fov_deg", view.fov_deg * before / Math.max(spread(), 1));
        } else {
            view.set("yaw_deg", view.yaw_deg - dx * perPixel() / Math.max(Math.cos(view.pitch_deg * Math.PI / 180), 0.2));
            view.set("pitch_deg", view.pitch_deg + dy * perPixel());
        }
        look();
    });
    for (const name of ["pointerup", "pointercancel"]) {
        canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        view.set("fov_deg", view.fov_deg * 1.001 ** event.deltaY);
        look();
    }, {passive: false});
    canvas.addEventListener("keydown", (event) => {
        const step = Math.max(view.fov_deg / 20, 0.1), shift = event.shiftKey;
        const turn = (name, by) => () => view.set(name, view[name] + by);
        const scale = (name, by) => () => view.set(name, view[name] * by);
        const action = {
            ArrowLeft: shift ? turn("sun_azimuth_deg", -2) : turn("yaw_deg", -step),
            ArrowRight: shift ? turn("sun_azimuth_deg", 2) : turn("yaw_deg", step),
            ArrowUp: shift ? turn("sun_zenith_deg", -0.5) : turn("pitch_deg", step),
            ArrowDown: shift ? turn("sun_zenith_deg", 0.5) : turn("pitch_deg", -step),
            "+": scale("fov_deg", 0.9), "=": scale("fov_deg", 0.9), "-": scale("fov_deg", 1 / 0.9),
            PageUp: scale("altitude_m", 1.2), PageDown: scale("altitude_m", 1 / 1.2),
            Home: () => {
                view.set("yaw_deg", view.sun_azimuth_deg);
                view.set("pitch_deg", Math.max(90 - view.sun_zenith_deg, -10));
            },
        }[event.key];
        if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        action();
        look();
    });
    new ResizeObserver(resize).observe(canvas);
}

function resize() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    if (canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    request();
}

async function text(name) {
    const answer = await fetch(name);
    const body = await answer.text();
    if (!answer.ok) {
        let found = `${name}: ${answer.status} ${answer.statusText}`;
        try {
            found = JSON.parse(body).error;
        } catch { /* not a line of ours */ }
        throw new Error(found);
    }
    return body;
}

async function start() {
    const names = ["state", "lookup.glsl", "sky.glsl", "display.glsl"];
    const [described, lookup, sky, display] = await Promise.all(names.map(text));
    state = JSON.parse(described);
    view = new View(state.start);
    byId("name").textContent = `Sky of ${state.name}`;
    byId("warnings").textContent = state.warnings.join(" ");
    resize();
    renderer = new Renderer(canvas, state, {lookup, sky, display});
    tables = new Tables(state, events);
    buildControls();
    listen();
    look();
    window.viewer = {view, tables, renderer, draw, look, exposure: () => exposure};
}

start().catch(showError);
