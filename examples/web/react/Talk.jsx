// A conversation with `smplxpp chat --serve --no-token`, which the site's proxy offers at a path (examples/deploy/nginx.conf).
import { useEffect, useRef, useState } from "react";

// `avatar` is the ref of an <Avatar>; `server` is the path.
export function Talk({ avatar, server }) {
  const dialogue = useRef(null), [said, setSaid] = useState([]), [note, setNote] = useState(""), [text, setText] = useState("");

  useEffect(() => {
    let left = false;
    const add = (who) => ({ text }) => text && setSaid((all) => [...all, { who, text }]);
    avatar.current.converse(server).then((it) => {
      if (left) return it.close();
      dialogue.current = it;
      it.on("open", () => setNote(""));
      it.on("hello", ({ partner }) => setNote(`${partner} answers`));
      it.on("heard", add("You"));
      it.on("answer", add("Avatar"));
      it.on("note", ({ text }) => setNote(text));
      it.on("lost", () => setNote("The connection is lost; it is tried again."));
    }, (error) => left || setNote(error.message));
    return () => { left = true; dialogue.current?.close(); };
  }, [avatar, server]);

  const send = (event) => {
    event.preventDefault(); // within the key or the click: browsers play no sound before
    if (dialogue.current?.type(text)) setText("");
  };
  return (
    <form onSubmit={send}>
      <ul>{said.map(({ who, text }, k) => <li key={k}>{who}: {text}</li>)}</ul>
      <label>Say <input value={text} onChange={(event) => setText(event.target.value)} /></label> <button>Send</button>
      <p><output>{note}</output></p>
    </form>
  );
}
