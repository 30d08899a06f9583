// Colours of numbers: a scale from dark violet to yellow (fitted to viridis), and colours that only tell labels apart.

const SCALE = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];

export const scaled = (t) => {
  const x = Math.min(Math.max(t, 0), 1) * (SCALE.length - 1), i = Math.min(Math.floor(x), SCALE.length - 2), f = x - i;
  return SCALE[i].map((c, k) => (c + f * (SCALE[i + 1][k] - c)) / 255);
};
export const gradient = `linear-gradient(90deg, ${SCALE.map((c) => `rgb(${c})`).join(", ")})`;

export const label = (n) => { // hues by the golden ratio
  if (n < 0) return [0.35, 0.35, 0.35];
  const hue = (n * 0.61803398875) % 1, light = 0.5 + 0.18 * ((n * 7) % 3) / 2;
  return [0, 8, 4].map((k) => {
    const a = (k + hue * 12) % 12;
    return light - 0.62 * Math.min(light, 1 - light) * Math.max(-1, Math.min(a - 3, 9 - a, 1));
  });
};

export const encode = (x) => { // sRGB's curve
  const v = Math.min(Math.max(x, 0), 1);
  return v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055;
};
export const decode = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
export const hex = (rgb) => "#" + rgb.map((v) => Math.round(255 * Math.min(Math.max(v, 0), 1)).toString(16).padStart(2, "0")).join("");
export const unhex = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);
