// 4 x 4 taxels as the server counts them: a disc for the normal force, a line for the shear.
export function taxels(canvas, values) {
  const pen = canvas.getContext("2d"), style = getComputedStyle(canvas);
  pen.setTransform(canvas.width / 640, 0, 0, canvas.height / 480, 0, 0);
  pen.clearRect(0, 0, 640, 480);
  values.forEach(([x, y, z], k) => {
    const u = 320 + 115 * ((k % 4) - 1.5), v = 240 + 115 * (Math.floor(k / 4) - 1.5);
    pen.fillStyle = style.getPropertyValue("--open");
    disc(pen, u, v, 50);
    pen.fillStyle = style.getPropertyValue("--done");
    disc(pen, u, v, Math.min(50, Math.sqrt(Math.abs(z)) * 0.9));
    pen.strokeStyle = style.getPropertyValue("--limited");
    pen.lineWidth = 4;
    pen.beginPath();
    pen.moveTo(u, v);
    pen.lineTo(u + x / 40, v - y / 40);
    pen.stroke();
  });
}

function disc(pen, x, y, radius) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
  pen.fill();
}
