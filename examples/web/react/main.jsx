// npm install react react-dom smplxpp-player, then any bundler: npx esbuild main.jsx --bundle --jsx=automatic --outfile=main.js
import { StrictMode, useCallback, useRef, useState } from "react";
import { createRoot } from "react-dom/client";
import { Avatar } from "./Avatar.jsx";

function App() {
  const guide = useRef(null), [status, setStatus] = useState("Opening"), [near, setNear] = useState(false);
  const ready = useCallback(({ name }) => setStatus(`${name} is here`), []);
  const speak = () => {
    // Visemes of a service (Azure's numbers, Oculus' or Polly's names) come with its sound: {audio, visemes}.
    const visemes = ["PP", "aa", "nn", "aa", "PP", "O", "SS", "E"].map((viseme, k) => ({ viseme, start: 0.14 * k }));
    guide.current.say({ visemes }).then(() => setStatus("Said"), (error) => setStatus(error.message));
    setStatus("Speaking");
  };
  return (
    <main>
      <h1>React</h1>
      <Avatar ref={guide} url="me.avatar" lips="lips.safetensors" view={near ? "chest" : "whole"} background="#e9eef7"
        style={{ width: 320, height: 420, borderRadius: 16 }} onReady={ready} onError={(error) => setStatus(error.message)} />
      <p role="status">{status}</p>
      <button onClick={speak}>Speak</button> <button onClick={() => setNear(!near)}>{near ? "All of her" : "Nearer"}</button>
    </main>
  );
}

createRoot(document.querySelector("#root")).render(<StrictMode><App /></StrictMode>);
