// The picture in WebGL2: a float picture of linear radiance, then the display transform.

const VERTEX = `#version 300 es
out vec2 place;
void main() {
    place = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(place, 0.0, 1.0);
}`;
const FRAGMENT = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler3D;\n";
const KEY = 0.45, HIGHLIGHT = 0.9;  // of atmo_jit/image.py
const LUMINANCE = [0.2126390, 0.7151687, 0.0721923];
const METER = [64, 36];  // pixels of the picture that sets the exposure

/** The factor that brings the log-mean luminance of float RGBA pixels to KEY (image.automatic_exposure). */
export function automaticExposure(pixels) {
    const values = [];
    for (let i = 0; i < pixels.length; i += 4) {
        const y = LUMINANCE[0] * pixels[i] + LUMINANCE[1] * pixels[i + 1] + LUMINANCE[2] * pixels[i + 2];
        if (y > 0 && Number.isFinite(y)) values.push(y);
    }
    if (!values.length) return 1;
    values.sort((a, b) => a - b);
    const cut = Math.floor(values.length / 100);
    const middle = values.slice(cut, values.length - cut);
    const mean = Math.exp(middle.reduce((sum, y) => sum + Math.log(y), 0) / middle.length);
    const at = 0.95 * (values.length - 1), low = Math.floor(at);
    const high = values[low] + (at - low) * (values[Math.min(low + 1, values.length - 1)] - values[low]);
    return Math.min(KEY / mean, HIGHLIGHT / high);
}

export class Renderer {
    /** Throws an Error that says what the browser lacks. */
    constructor(canvas, state, sources) {
        const gl = canvas.getContext("webgl2", {antialias: false, alpha: false, preserveDrawingBuffer: true});
        if (!gl) throw new Error("This browser has no WebGL2, which the picture needs.");
        if (gl.getExtension("EXT_color_buffer_float")) this.floats = gl.RGBA32F;
        else if (gl.getExtension("EXT_color_buffer_half_float")) this.floats = gl.RGBA16F;
        else throw new Error("This browser cannot draw to float pictures.");
        // Where float texels cannot be read linearly, half ones can.
        this.format = gl.getExtension("OES_texture_float_linear") ? gl.RGB32F : gl.RGB16F;
        this.gl = gl;
        this.state = state;
        const [altitudes, rows, angles, suns] = state.scattering;
        this.textures = {
            atm_transmittance_texture: this.flat(state.transmittance[1], state.transmittance[0]),
            atm_irradiance_texture: this.flat(state.irradiance[1], state.irradiance[0]),
            to_ground_texture: this.flat(rows / 2, altitudes),
            atm_scattering_texture: this.solid(angles * suns, rows, altitudes),
            atm_single_mie_texture: this.solid(angles * suns, rows, altitudes),
        };
        this.sky = this.program(`${FRAGMENT}uniform float mie_g;\n${sources.lookup}${sources.sky}`);
        this.display = this.program(FRAGMENT + sources.display);
        this.targets = {};
        this.air = {g: 0, ground_albedo: [0, 0, 0]};
        gl.bindVertexArray(gl.createVertexArray());
    }

    flat(width, height) {
        const {gl} = this, texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
        this.linear(gl.TEXTURE_2D);
        return {texture, target: gl.TEXTURE_2D, width, height};
    }

    solid(width, height, depth) {
        const {gl} = this, texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_3D, texture);
        gl.texStorage3D(gl.TEXTURE_3D, 1, this.format, width, height, depth);
        this.linear(gl.TEXTURE_3D);
        gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_WRAP_R, gl.CLAMP_TO_EDGE);
        return {texture, target: gl.TEXTURE_3D, width, height, depth};
    }

    linear(target) {
        const {gl} = this;
        for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, key, gl.LINEAR);
        for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, key, gl.CLAMP_TO_EDGE);
    }

    program(fragment) {
        const {gl} = this, program = gl.createProgram();
        for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
            const shader = gl.createShader(kind);
            gl.shaderSource(shader, source);
            gl.compileShader(shader);
            gl.attachShader(program, shader);
        }
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
            const logs = gl.getAttachedShaders(program).map((s) => gl.getShaderInfoLog(s)).join("");
            throw new Error(`The shader does not compile: ${logs || gl.getProgramInfoLog(program)}`);
        }
        const uniforms = {}, count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
        for (let i = 0; i < count; i++) {
            const {name} = gl.getActiveUniform(program, i);
            uniforms[name] = gl.getUniformLocation(program, name);
        }
        return {program, uniforms};
    }

    /** Texels of a block as the server sends them, into the textures. */
    upload(about, numbers) {
        const {gl, state} = this, [, rows, angles, suns] = state.scattering;
        const [a0, a1] = about.altitudes, [s0, s1] = about.suns;
        let at = 0;
        const take = (count) => numbers.subarray(at, at += count);
        for (const name of ["atm_transmittance_texture", "atm_irradiance_texture", "to_ground_texture"]) {
            const {texture, width, height} = this.textures[name];
            gl.bindTexture(gl.TEXTURE_2D, texture);
            const part = take(3 * width * height);
            gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGB, gl.FLOAT, part);
        }
        const few = s1 - s0;
        gl.pixelStorei(gl.UNPACK_ROW_LENGTH, angles * few);
        for (const name of ["atm_scattering_texture", "atm_single_mie_texture"]) {
            gl.bindTexture(gl.TEXTURE_3D, this.textures[name].texture);
            const part = take(3 * (a1 - a0) * rows * angles * few);
            for (let k = 0; k < angles; k++) {
                gl.pixelStorei(gl.UNPACK_SKIP_PIXELS, k * few);
                gl.texSubImage3D(
                    gl.TEXTURE_3D, 0, k * suns + s0, 0, a0, few, rows, a1 - a0, gl.RGB, gl.FLOAT, part);
            }
        }
        gl.pixelStorei(gl.UNPACK_ROW_LENGTH, 0);
        gl.pixelStorei(gl.UNPACK_SKIP_PIXELS, 0);
        this.air = about;
    }

    /** A float picture to draw into, of this size, kept by name. */
    target(name, width, height) {
        const {gl} = this, last = this.targets[name];
        if (last && last.width === width && last.height === height) return last;
        if (last) {
            gl.deleteTexture(last.texture);
            gl.deleteFramebuffer(last.buffer);
        }
        const texture = gl.createTexture(), buffer = gl.createFramebuffer();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texStorage2D(gl.TEXTURE_2D, 1, this.floats, width, height);
        for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
            gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
        }
        gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        return this.targets[name] = {texture, buffer, width, height};
    }

    /** Radiance of a view (camera.js) into a float picture. */
    radiance(view, target) {
        const {gl, state} = this, {program, uniforms: u} = this.sky;
        gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
        gl.viewport(0, 0, target.width, target.height);
        gl.useProgram(program);
        Object.entries(this.textures).forEach(([name, {texture, target: kind}], i) => {
            gl.activeTexture(gl.TEXTURE0 + i);
            gl.bindTexture(kind, texture);
            gl.uniform1i(u[name], i);
        });
        gl.activeTexture(gl.TEXTURE0 + 8);  // later bindings disturb none of these
        const axes = view.axes(target.width / target.height);
        gl.uniform3fv(u.forward, axes[0]);
        gl.uniform3fv(u.right, axes[1]);
        gl.uniform3fv(u.up, axes[2]);
        gl.uniform3fv(u.sun, view.sun());
        gl.uniform1f(u.altitude, view.altitude_m);
        gl.uniform3fv(u.solar, state.solar);
        gl.uniform3fv(u.albedo, this.air.ground_albedo);
        gl.uniform1f(u.mie_g, this.air.g);
        gl.uniform1f(u.sun_radius, state.sun_angular_radius_deg * Math.PI / 180);
        gl.uniformMatrix3fv(u.to_srgb, true, state.to_srgb.flat());
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    /** Float RGBA pixels of a picture, the lowest row first. */
    read(target) {
        const {gl} = this, pixels = new Float32Array(4 * target.width * target.height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
        gl.readPixels(0, 0, target.width, target.height, gl.RGBA, gl.FLOAT, pixels);
        return pixels;
    }

    /** Wait until all is drawn. */
    finish() {
        const {gl} = this;
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    }

    /** The automatic exposure of a view. */
    meter(view, aspect) {
        const width = Math.round(Math.sqrt(METER[0] * METER[1] * aspect)) || 1;
        const meter = this.target("meter", width, Math.max(1, Math.round(width / aspect)));
        this.radiance(view, meter);
        return automaticExposure(this.read(meter));
    }

    /** Draw a view to the canvas, its radiance at a size of width x height pixels. */
    draw(view, exposure, width, height) {
        const {gl} = this, picture = this.target("picture", width, height);
        this.radiance(view, picture);
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
        gl.useProgram(this.display.program);
        gl.bindTexture(gl.TEXTURE_2D, picture.texture);
        gl.uniform1i(this.display.uniforms.picture, 8);
        gl.uniform1f(this.display.uniforms.exposure, exposure);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
        return picture;
    }
}
