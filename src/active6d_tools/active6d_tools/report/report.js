"use strict";
// The path in 3D: an orthographic camera turned by dragging. World is z up, metres.
(() => {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const canvas = document.getElementById("path");
  const pen = canvas.getContext("2d");
  const R = scene.radius;
  let azimuth = -0.9, elevation = 0.42;
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

  const arc = (a, b) => {
    const angle = Math.acos(Math.max(-1, Math.min(1, dot(a, b) / (R * R))));
    const count = Math.max(2, Math.ceil(angle / 0.05));
    return Array.from({ length: count + 1 }, (_, i) => {
      const t = i / count, s = Math.sin(angle);
      const u = s < 1e-6 ? 1 - t : Math.sin((1 - t) * angle) / s, v = s < 1e-6 ? t : Math.sin(t * angle) / s;
      return a.map((x, k) => u * x + v * b[k]);
    });
  };
  const ring = (count, point) => Array.from({ length: count + 1 }, (_, i) => point(i / count));
  const onSphere = (az, el) => [R * Math.cos(el) * Math.cos(az), R * Math.cos(el) * Math.sin(az), R * Math.sin(el)];

  const draw = () => {
    const style = getComputedStyle(document.documentElement);
    const color = name => style.getPropertyValue(name).trim();
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = pen.lineCap = "round";
    const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
    const toward = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    const up = [-Math.sin(elevation) * Math.cos(azimuth), -Math.sin(elevation) * Math.sin(azimuth), Math.cos(elevation)];
    const scale = Math.min(width / (2.2 * R), height / (1.7 * R));
    const place = p => [width / 2 + scale * dot(p, right), height * 0.66 - scale * (dot(p, up)), dot(p, toward)];
    const line = (points, stroke, thickness, alpha = 1) => {
      pen.globalAlpha = alpha;
      pen.strokeStyle = stroke;
      pen.lineWidth = thickness;
      pen.beginPath();
      points.forEach((p, i) => { const [x, y] = place(p); i ? pen.lineTo(x, y) : pen.moveTo(x, y); });
      pen.stroke();
      pen.globalAlpha = 1;
    };
    const disc = (p, radius, fill, alpha = 1) => {
      const [x, y] = place(p);
      pen.globalAlpha = alpha;
      pen.fillStyle = fill;
      pen.beginPath();
      pen.arc(x, y, radius, 0, 7);
      pen.fill();
      pen.globalAlpha = 1;
      return [x, y];
    };
    const soft = color("--soft"), accent = color("--accent"), panel = color("--panel");
    for (const el of [0, Math.PI / 6, Math.PI / 3]) line(ring(72, t => onSphere(2 * Math.PI * t, el)), soft, 1, el ? 0.18 : 0.4);
    for (let k = 0; k < 6; k++) line(ring(48, t => onSphere(k * Math.PI / 6, Math.PI * t)), soft, 1, 0.18);
    scene.grid.forEach(p => disc(p, 1.6, soft, dot(p, toward) > 0 ? 0.55 : 0.22));
    [...scene.objects].sort((a, b) => dot(a.position, toward) - dot(b.position, toward))
      .forEach(object => disc(object.position, Math.max(3, 0.3 * scale * scene.size), object.color, 0.9));
    const cameras = scene.cameras;
    cameras.slice(1).forEach((b, i) => line(arc(cameras[i], b), accent, 3, 0.85));
    cameras.forEach((p, i) => {
      line([p, p.map(x => x * 0.86)], accent, 1.5, 0.8);
      const [x, y] = disc(p, 10, i === cameras.length - 1 ? accent : panel);
      pen.strokeStyle = accent;
      pen.lineWidth = 2;
      pen.stroke();
      pen.fillStyle = i === cameras.length - 1 ? panel : accent;
      pen.font = "600 11px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillText(i, x, y + 0.5);
    });
  };

  canvas.addEventListener("pointerdown", event => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", event => {
    if (!event.buttons) return;
    azimuth -= event.movementX * 0.01;
    elevation = Math.max(0.02, Math.min(1.55, elevation + event.movementY * 0.01));
    draw();
  });
  new ResizeObserver(draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
})();

// Pointing at an object, in the picture or in the table, lights it up in both.
document.querySelectorAll(".step").forEach(step => step.addEventListener("pointerover", event => {
  const row = event.target.closest("[data-row]")?.dataset.row;
  step.querySelectorAll("[data-row]").forEach(item => item.classList.toggle("lit", item.dataset.row === row));
}));
