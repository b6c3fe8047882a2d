// The tables of the server, as far as they are here: what a view needs first, the rest when nothing else is wanted.

const IDLE_MS = 400;      // after the last change, before the rest of the tables is asked for
const REST_ALTITUDES = 2;  // at a time, so that a change never waits long

/** JSON and numbers of a framed answer (server: live.framed). */
function unframed(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const about = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    return [about, new Float32Array(buffer, 4 + length)];
}

/** A JSON object and float32 numbers in one body. */
export function framed(about, numbers) {
    const bytes = new TextEncoder().encode(JSON.stringify(about));
    const padded = new Uint8Array(Math.ceil(bytes.length / 4) * 4).fill(32);
    padded.set(bytes);
    return new Blob([new Uint32Array([padded.length]), padded, numbers]);
}

/** POST JSON; the answer, or an Error with the server's line. */
export async function ask(name, body, kind = "application/json") {
    const answer = await fetch(name, {method: "POST", headers: {"Content-Type": kind}, body}).catch(() => {
        throw new Error("The server does not answer: is atmo-jit view still running?");
    });
    if (!answer.ok) {
        const found = await answer.json().catch(() => ({}));
        throw new Error(found.error || `${name}: ${answer.status} ${answer.statusText}`);
    }
    return answer;
}

export class Tables {
    /** `events`: upload(about, numbers), changed(timings), error(found), known(share), fail(error). */
    constructor(state, events) {
        this.state = state;
        this.events = events;
        this.parameters = {};
        this.known = this.nothing();
        this.estimated = null;
        this.last = performance.now();
        this.busy = false;
    }

    nothing() {
        const [altitudes, , , suns] = this.state.scattering;
        return Array.from({length: altitudes}, () => new Array(suns).fill(false));
    }

    /** Altitudes and suns that a view reads, [first, end] each. */
    needs(view) {
        const {altitudes_m, suns_deg, thickness_m, scattering} = this.state;
        const [count, , , suns] = scattering;
        if (view.altitude_m > thickness_m) return [[count - 1, count], [0, suns]];
        const above = altitudes_m.findIndex((h) => h > view.altitude_m);
        const low = Math.max(0, (above < 0 ? count : above) - 1);
        const higher = suns_deg.findIndex((angle) => angle < view.sun_zenith_deg);
        const first = Math.max(0, (higher < 0 ? suns : higher) - 2);  // one more on either side, for the next move
        return [[low, Math.min(low + 2, count)], [first, Math.min(first + 4, suns)]];
    }

    has([[a0, a1], [s0, s1]]) {
        return this.known.slice(a0, a1).every((row) => row.slice(s0, s1).every(Boolean));
    }

    /** Other parameters: nothing that is here holds any longer. */
    change(parameters) {
        this.parameters = parameters;
        this.known = this.nothing();
        this.estimated = null;
        this.changed = performance.now();
        this.want(this.view);
    }

    /** The view that is to be drawn. */
    want(view) {
        this.view = view;
        this.last = performance.now();
        this.pump();
    }

    async pump() {
        if (this.busy || !this.view) return;
        const job = this.next();
        if (!job) return;
        this.busy = true;
        try {
            await job();
        } catch (error) {
            this.events.fail(error);
            this.failed = JSON.stringify(this.parameters);
        }
        this.busy = false;
        this.pump();
    }

    next() {
        if (this.failed === JSON.stringify(this.parameters)) return null;
        const needed = this.needs(this.view);
        if (!this.has(needed)) return () => this.block(needed, true);
        const wait = this.last + IDLE_MS - performance.now();
        if (wait > 0) return this.later(wait);
        const key = `${this.view.altitude_m} ${this.view.sun_zenith_deg} ${this.known.flat().every(Boolean)}`;
        if (this.estimated !== key) return () => this.estimate(key);
        const suns = this.state.scattering[3];
        const missing = this.known.flatMap((row, i) => (row.every(Boolean) ? [] : [i]));
        if (!missing.length) return null;
        const [[centre]] = needed;
        missing.sort((a, b) => Math.abs(a - centre) - Math.abs(b - centre));
        const first = Math.min(missing[0], this.known.length - REST_ALTITUDES);
        return () => this.block([[first, first + REST_ALTITUDES], [0, suns]], false);
    }

    later(wait) {
        clearTimeout(this.timer);
        this.timer = setTimeout(() => this.pump(), wait + 1);
        return null;
    }

    async block([altitudes, suns], shown) {
        const parameters = this.parameters, began = this.changed;
        const answer = await ask("texels", JSON.stringify({parameters, altitudes, suns}));
        const [about, numbers] = unframed(await answer.arrayBuffer());
        if (parameters !== this.parameters && !shown) return;
        this.events.upload(about, numbers);
        if (parameters === this.parameters) {
            for (let a = altitudes[0]; a < altitudes[1]; a++) this.known[a].fill(true, suns[0], suns[1]);
            this.events.known(this.known.flat().filter(Boolean).length / this.known.flat().length);
        }
        if (shown) this.events.changed({...about, began});
    }

    async estimate(key) {
        const parameters = this.parameters, {altitude_m, sun_zenith_deg} = this.view;
        const answer = await ask("error", JSON.stringify({parameters, altitude_m, sun_zenith_deg}));
        const found = await answer.json();
        if (parameters !== this.parameters) return;
        this.estimated = key;
        this.events.error(found);
    }
}
