class Fisheye: pass
class LatLong: pass
