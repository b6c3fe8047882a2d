// The observer: where the camera is, where it looks, and where the sun stands. Angles in degrees, z up.

const RADIANS = Math.PI / 180;
export const LIMITS = {
    sun_zenith_deg: [0, 110], sun_azimuth_deg: [0, 360], altitude_m: [2, 4e7],
    yaw_deg: [0, 360], pitch_deg: [-90, 90], fov_deg: [1, 120], stops: [-8, 8],
};

export class View {
    constructor(start) {
        Object.assign(this, start);
    }

    /** Set a value, kept within its limits; azimuths go round. */
    set(name, value) {
        const [low, high] = LIMITS[name];
        if (!Number.isFinite(value)) return;
        if (high === 360) value = ((value % 360) + 360) % 360;
        this[name] = Math.min(Math.max(value, low), high);
    }

    direction(azimuth, elevation) {
        const a = azimuth * RADIANS, e = elevation * RADIANS;
        return [Math.cos(e) * Math.sin(a), Math.cos(e) * Math.cos(a), Math.sin(e)];
    }

    sun() {
        return this.direction(this.sun_azimuth_deg, 90 - this.sun_zenith_deg);
    }

    /** Forward, and half the picture's width and height; the field of view is that of the longer side. */
    axes(aspect) {
        const tangent = Math.tan(0.5 * this.fov_deg * RADIANS), longer = Math.max(aspect, 1);
        const right = this.direction(this.yaw_deg + 90, 0).map((c) => c * tangent * aspect / longer);
        const up = this.direction(this.yaw_deg, this.pitch_deg + 90).map((c) => c * tangent / longer);
        return [this.direction(this.yaw_deg, this.pitch_deg), right, up];
    }
}
