// The render on the page as a command for a shell.

/** One word of a POSIX shell. */
export function quoted(word) {
  return /^[\w./:,=@%+-]+$/.test(word) ? word : `'${word.replaceAll("'", `'\\''`)}'`;
}

/** The same render by curl. A file is named as it was here: run it beside that file. */
export function asCurl(url, source, request) {
  const end = `${quoted(url)} -o ${quoted(fileName(source.name, "png"))}`;
  if (!source.file) {
    const body = JSON.stringify({ stage: source.name, ...request });
    return `curl --fail-with-body -H 'Content-Type: application/json' -d ${quoted(body)} ${end}`;
  }
  const asFile = (name) => (/[;,"\\]/.test(name) ? `"${name.replace(/[\\"]/g, "\\$&")}"` : name);
  const parts = (source.parts ?? []).map(({ name }) => ` -F ${quoted(`file=@${asFile(name)}`)}`).join("");
  return `curl --fail-with-body -F ${quoted(`stage=@${asFile(source.name)}`)}${parts} --form-string ${quoted(`settings=${JSON.stringify(request)}`)} ${end}`;
}

/** What a file made of a stage is called: the stage's own name, with another ending. */
export const fileName = (name, ending) => `${name.replace(/^.*\//, "").replace(/\.(usd[acz]?|glb|gltf|zip)$/i, "")}.${ending}`;

/** The same render by the command line. */
export function asCli(source, request) {
  const { overrides = {}, time_code: time = null, ...flags } = request;
  const hashes = time === null ? "" : Number.isInteger(time) ? "####." : "####.###.";
  const words = ["refract", "render", source.name, fileName(source.name, `${hashes}png`)];
  for (const [name, value] of Object.entries(flags)) {
    const flag = `--${name.replaceAll("_", "-")}`;
    words.push(...(String(value).startsWith("-") ? [`${flag}=${value}`] : [flag, String(value)]));
  }
  for (const [path, fields] of Object.entries(overrides)) {
    for (const [name, value] of Object.entries(fields)) words.push("--override", `${path}.${name}=${value}`);
  }
  if (time !== null) words.push(...(time < 0 ? [`--frames=${time}`] : ["--frames", String(time)]));
  return words.map(quoted).join(" ");
}
