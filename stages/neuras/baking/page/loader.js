// Reads the files of a baked scene and makes textures' data of them.

export const fetched = async (name) => {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name} cannot be read (${answer.status}): is the folder complete?`);
  return answer;
};

// The bytes of a PNG as they were written: no colour conversion, alpha not multiplied in. RGBA, row 0 on top.
async function pixels(blob) {
  const bitmap = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2");
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
  const frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE)
    throw new Error(`A texture of ${bitmap.width} x ${bitmap.height} is larger than this browser takes`);
  const data = new Uint8Array(4 * bitmap.width * bitmap.height);
  gl.readPixels(0, 0, bitmap.width, bitmap.height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return data;
}

// The faces of the skyboxes one after the other, from a picture with a row of six for each skybox.
function stacked(data, { count, side }) {
  const step = data.length / (6 * side * side * count), out = new data.constructor(data.length);
  for (let skybox = 0; skybox < count; skybox++)
    for (let face = 0; face < 6; face++)
      for (let row = 0; row < side; row++) {
        const from = step * side * (6 * (skybox * side + row) + face);
        out.set(data.subarray(from, from + step * side), step * side * ((6 * skybox + face) * side + row));
      }
  return out;
}

// Positions, texture coordinates, charts and indices of a binary glTF with one mesh, as lightmill writes it.
function readGeometry(buffer) {
  const view = new DataView(buffer), length = view.getUint32(12, true);
  const document = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
  const start = 20 + length + 8, primitive = document.meshes[0].primitives[0];
  const array = (index, kind) => {
    const accessor = document.accessors[index], place = document.bufferViews[accessor.bufferView];
    return new kind(buffer, start + place.byteOffset, place.byteLength / kind.BYTES_PER_ELEMENT);
  };
  return {
    indices: array(primitive.indices, Uint32Array),
    position: array(primitive.attributes.POSITION, Float32Array),
    uv: array(primitive.attributes.TEXCOORD_0, Float32Array),
    chart: array(primitive.attributes._CHART, Float32Array),
  };
}

export async function loadScene(say) {
  const scene = await (await fetched("scene.json")).json();
  scene.bytes = 0;
  const bytes = async (name) => {
    say(`Loading ${name} ..`);
    const blob = await (await fetched(name)).blob();
    scene.bytes += blob.size;
    return blob;
  };
  const text = async (name) => (await bytes(name)).text();
  scene.shaders = {};
  for (const name of ["mesh", "sky", "resolve"])
    scene.shaders[name] = [await text(`shaders/${name}.web.vert`), await text(`shaders/${name}.web.frag`)];
  scene.geometry = readGeometry(await (await bytes("geometry.glb")).arrayBuffer());
  if (scene.quantized) {
    const codes = async (name) => {
      const rgba = await pixels(await bytes(name));
      return Uint16Array.from({ length: rgba.length / 4 }, (_, i) => rgba[4 * i] + 256 * rgba[4 * i + 1]);
    };
    scene.meshCodes = await codes("mesh_codes.png");
    scene.skyCodes = stacked(await codes("sky_codes.png"), scene.skyboxes);
    const books = new Float32Array(await (await bytes("codebooks.bin")).arrayBuffer());
    const end = scene.codes.mesh * scene.channels;
    scene.books = { mesh: books.subarray(0, end), sky: books.subarray(end) };
  } else {
    scene.meshMaps = [];
    scene.skyMaps = [];
    for (let i = 0; i < scene.textures; i++) {
      scene.meshMaps.push(await pixels(await bytes(`mesh_${i}.png`)));
      scene.skyMaps.push(stacked(await pixels(await bytes(`sky_${i}.png`)), scene.skyboxes));
    }
  }
  say("Preparing ..");
  return scene;
}

const halves = (() => { // single to half precision, rounded to nearest
  const float = new Float32Array(1), bits = new Uint32Array(float.buffer);
  return (value) => {
    float[0] = value;
    const x = bits[0], sign = (x >>> 16) & 0x8000, exponent = ((x >>> 23) & 255) - 112, mantissa = x & 0x7fffff;
    if (exponent >= 31) return sign | 0x7bff;
    if (exponent <= 0) {
      if (exponent < -10) return sign;
      const full = mantissa | 0x800000, shift = 14 - exponent;
      return sign | ((full + (1 << (shift - 1))) >>> shift);
    }
    return sign | (((exponent << 10) | (mantissa >>> 13)) + ((mantissa >>> 12) & 1));
  };
})();

// Codes become maps of four channels each: a small table per code, then one copy per texel.
export function expandCodes(scene) {
  if (!scene.quantized) return;
  const half = scene.expand === "fp16", kind = half ? Uint16Array : Uint8Array;
  for (const name of ["mesh", "sky"]) {
    const book = scene.books[name], count = book.length / scene.channels, range = scene.ranges[name];
    const codes = scene[`${name}Codes`];
    scene[`${name}Maps`] = Array.from({ length: scene.textures }, (_, part) => {
      const table = new kind(4 * count);
      for (let code = 0; code < count; code++)
        for (let c = 0; c < 4; c++) {
          const channel = 4 * part + c;
          const value = channel < scene.channels ? book[code * scene.channels + channel] : 0;
          table[4 * code + c] = half ? halves(value)
            : range.span[channel] > 0 ? Math.round((255 * (value - range.low[channel])) / range.span[channel]) : 0;
        }
      const packed = half ? new BigUint64Array(table.buffer) : new Uint32Array(table.buffer);
      const maps = half ? new BigUint64Array(codes.length) : new Uint32Array(codes.length);
      for (let i = 0; i < codes.length; i++) maps[i] = packed[codes[i]];
      return new kind(maps.buffer);
    });
  }
}
