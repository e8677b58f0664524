// A dropped folder as one archive: a ZIP file without compression (PKWARE's APPNOTE 6.3.10).

const TABLE = Uint32Array.from({ length: 256 }, (_, k) => {
  let value = k;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? 0xEDB88320 ^ (value >>> 1) : value >>> 1;
  return value;
});
const TEXT = /\.(toml|csv|json)$/;  // what a run is read from; its pages are made anew
const VERSION = 20, UTF8 = 0x800;

function checksum(bytes) {
  let value = -1;
  for (const byte of bytes) value = TABLE[(value ^ byte) & 255] ^ (value >>> 8);
  return ~value >>> 0;
}

/** A record of little-endian numbers: pairs of bytes and value. */
function record(...pairs) {
  const view = new DataView(new ArrayBuffer(pairs.reduce((sum, [bytes]) => sum + bytes, 0)));
  let at = 0;
  for (const [bytes, value] of pairs) {
    if (bytes === 4) view.setUint32(at, value, true); else view.setUint16(at, value, true);
    at += bytes;
  }
  return new Uint8Array(view.buffer);
}

/** The archive of files, each a name and its bytes. */
export function zipped(files) {
  const parts = [], directory = [];
  let offset = 0, listed = 0;
  for (const { name, bytes } of files) {
    const title = new TextEncoder().encode(name), sum = checksum(bytes);
    const shared = [[2, VERSION], [2, UTF8], [2, 0], [4, 0], [4, sum], [4, bytes.length],
      [4, bytes.length], [2, title.length], [2, 0]];
    const head = record([4, 0x04034B50], ...shared);
    const entry = record([4, 0x02014B50], [2, VERSION], ...shared, [2, 0], [2, 0], [2, 0], [4, 0],
      [4, offset]);
    parts.push(head, title, bytes);
    directory.push(entry, title);
    offset += head.length + title.length + bytes.length;
    listed += entry.length + title.length;
  }
  const end = record([4, 0x06054B50], [2, 0], [2, 0], [2, files.length], [2, files.length],
    [4, listed], [4, offset], [2, 0]);
  return new Blob([...parts, ...directory, end], { type: "application/zip" });
}

/** A dropped run's folder as an archive. */
export async function archived(folder) {
  const reader = folder.createReader(), entries = [];
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length) break;
    entries.push(...some);
  }
  const wanted = entries.filter((entry) => entry.isFile && TEXT.test(entry.name));
  return zipped(await Promise.all(wanted.map(async (entry) => {
    const file = await new Promise((done, fail) => entry.file(done, fail));
    return { name: `${folder.name}/${entry.name}`,
      bytes: new Uint8Array(await file.arrayBuffer()) };
  })));
}
